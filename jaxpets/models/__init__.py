"""Models that come with the library, and what a file says about its model.

`jaxpets.save_model`, `jaxpets.load_model` and `jaxpets.pretrained` write and read them.
"""

from jaxpets._src.model_file import about
from jaxpets._src.pretrained import names, path

__all__ = ["about", "names", "path"]

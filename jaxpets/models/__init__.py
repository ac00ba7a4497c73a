"""Models that come along, what a file says about itself, and planning without noise.

`jaxpets.save_model`, `jaxpets.load_model` and `jaxpets.pretrained` write and read them.
"""

from jaxpets._src.by_means import by_means
from jaxpets._src.ensemble_params import without_noise
from jaxpets._src.model_file import about
from jaxpets._src.pretrained import names, path

__all__ = ["about", "by_means", "names", "path", "without_noise"]

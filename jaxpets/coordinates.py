"""Tables of an observation's entries: the space they mean, their names, their text."""

from jaxpets._src.coordinates import (
    KINDS,
    from_json,
    index,
    space,
    table,
    to_json,
)
from jaxpets._src.types import Coordinate

__all__ = ["KINDS", "Coordinate", "from_json", "index", "space", "table", "to_json"]

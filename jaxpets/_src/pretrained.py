"""The models that come with the library."""

from pathlib import Path

from jaxpets._src.checks import nearest
from jaxpets._src.ensemble import Ensemble
from jaxpets._src.ensemble_params import EnsembleParams
from jaxpets._src.model_file import load_model

_SHIPPED = Path(__file__).parents[1] / "models"


def names() -> tuple[str, ...]:
    """Returns the names of the models that come with the library."""
    files = (file.relative_to(_SHIPPED) for file in _SHIPPED.rglob("*.safetensors"))
    return tuple(sorted(file.with_suffix("").as_posix() for file in files))


def path(name: str) -> Path:
    """Returns the file of a model that comes with the library.

    Raises:
      ValueError: if there is no such model; the nearest names are said.
    """
    if name not in names():
        near = ", ".join(nearest(name, names()) or names())
        raise ValueError(f"name must be a model, as {near}, got {name!r}.")
    return _SHIPPED / f"{name}.safetensors"


def pretrained(name: str) -> tuple[Ensemble, EnsembleParams]:
    """Returns a model that comes with the library: it explored without a reward.

    Of which robot it is, the numbers to plan with, and how it came to be are in
    `models.about(models.path(name))`.

    Args:
      name: "best" or "epistemic", two arms of the README on HalfCheetah; "dmc/walker"
        and others of `models.names()`, of the DeepMind Control Suite.

    Returns:
      The ensemble and what it has learned, as `load_model`.

    Raises:
      ValueError: if there is no such model; the nearest names are said.
    """
    return load_model(path(name))

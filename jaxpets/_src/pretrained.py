"""The models and the policies that come with the library."""

from pathlib import Path

from jaxpets._src.checks import nearest
from jaxpets._src.ensemble import Ensemble
from jaxpets._src.ensemble_params import EnsembleParams
from jaxpets._src.model_file import load_model

_SHIPPED = Path(__file__).parents[1] / "models"
_POLICIES = _SHIPPED / "policies"


def names() -> tuple[str, ...]:
    """Returns the names of the models that come with the library."""
    apart = f"{_POLICIES.name}/"
    return tuple(name for name in _below(_SHIPPED) if not name.startswith(apart))


def path(name: str) -> Path:
    """Returns the file of a model that comes with the library.

    Raises:
      ValueError: if there is no such model; the nearest names are said.
    """
    return _named(name, "model", names(), _SHIPPED)


def policy_path(name: str) -> Path:
    """Returns the file of a policy that comes with the library.

    It was learned in what the model of that name imagines, and performs without a
    plan. `load_policy(path("best"), goals=Goals(features=jnp.stack))` reads it, to act
    on `tasks.params` of the robot, which it sees. How it came to be is in
    `models.about(path("best"))`.

    Args:
      name: "best", which performs all four tasks of HalfCheetah.

    Raises:
      ValueError: if there is no such policy; the nearest names are said.
    """
    return _named(name, "policy", _below(_POLICIES), _POLICIES)


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


def _below(folder: Path) -> tuple[str, ...]:
    """Returns the names of the files in a folder and those below."""
    files = (file.relative_to(folder) for file in folder.rglob("*.safetensors"))
    return tuple(sorted(file.with_suffix("").as_posix() for file in files))


def _named(name: str, kind: str, known: tuple[str, ...], folder: Path) -> Path:
    if name not in known:
        near = ", ".join(nearest(name, known) or known)
        raise ValueError(f"name must be a {kind}, as {near}, got {name!r}.")
    return folder / f"{name}.safetensors"

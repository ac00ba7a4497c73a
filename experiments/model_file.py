"""A model as one file, in place of the run that explored it.

`pretrained/NAME` is one that comes with the library; any other is a path. Such a model
performs, but there are no data to learn on.
"""

import dataclasses
import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, cast

import jax
import msgspec

import jaxpets
from jaxpets import models

from . import robots, user_files
from .config import Config, ModelConfig, PlannerConfig
from .entries import from_json, to_json
from .errors import CheckpointError, UsageError
from .presets import preset_config
from .storage import rundir
from .storage.identity import unlike

if TYPE_CHECKING:  # it brings orbax, which wrong flags need not wait for
    from .storage.folder import RunFolder

PRETRAINED = "pretrained"


class Model(NamedTuple):
    """What is in a file; all of it may come from a stranger."""

    path: Path
    about: Mapping[str, Any]
    ensemble: jaxpets.Ensemble
    params: jaxpets.EnsembleParams


class ModelFile(NamedTuple):
    """What performing needs of the folder of a run, of a file."""

    path: Path

    def digest(self) -> str:
        """Returns what no other file has: the folder of its results is of its name."""
        return hashlib.sha256(self.path.read_bytes()).hexdigest()

    def steps(self) -> list[int]:
        """Returns the trials behind the model: one number, 0 if the file has none."""
        return [_training(models.about(self.path)).get("num_trials", 0)]

    def below(self, pattern: str) -> list[Any]:
        """Returns no run: nothing performed in this folder."""
        del pattern
        return []

    def restore_trial(self, trial: int, template: Any, *, part: bool) -> Any:
        """Returns a learner `[S]` that has the model of one seed, and nothing else."""
        from . import exploration  # it brings MuJoCo and orbax, as RunFolder does

        del trial, part
        form: Any = template({}) if callable(template) else template
        params = jax.tree.map(lambda x: x[None], read(self.path, str(self.path)).params)
        return exploration.model_of(form._replace(params=params))


Source: TypeAlias = "RunFolder | ModelFile"  # what a later phase starts from


def named(
    source: Path,
    flag: str = "--from",
    shipped: Callable[[str], Path] = models.path,
    plain: str = "epistemic",
) -> Path:
    """Returns the path of a file or folder, which may be called `pretrained/NAME`.

    Args:
      source: as the command line names it.
      flag: that does.
      shipped: returns the file of a name, or raises a ValueError.
      plain: the name that `pretrained` alone stands for.

    Raises:
      UsageError: if nothing of that name comes with the library.
    """
    if source.exists() or source.parts[:1] != (PRETRAINED,):
        return source
    try:
        return shipped("/".join(source.parts[1:]) or plain)
    except ValueError as error:
        raise UsageError(f"{flag} {source} is not valid; {error}") from error


def read(path: Path, said: str) -> Model:
    """Reads a model.

    Args:
      path: of the file.
      said: what the user calls it.

    Raises:
      UsageError: if there is no such file.
      CheckpointError: if it is not one of a model.
    """
    try:
        return Model(path, models.about(path), *jaxpets.load_model(path))
    except FileNotFoundError as error:
        valid = "there is no such run or model"
        raise UsageError(f"--from {said} is not valid; {valid}.") from error
    except (TypeError, ValueError) as error:
        raise CheckpointError(str(error)) from error


def training(run: "RunFolder", config: Config, seed: int, trial: int) -> dict[str, Any]:
    """Returns how the model of a run came to be, as a file says it."""
    refitted = config.phase != "explore" and config.refit.num_epochs
    return {
        "arm": rundir.label(config.arm),
        "seed": seed,
        "num_trials": trial,
        "trial_length": config.trial_length,
        "refit": to_json(config.refit) if refitted else None,
        "software": run.find_json(rundir.ENVIRONMENT),
    }


def origin(source: Source) -> dict[str, Any]:
    """Returns which model a phase starts from, and what only its file knows of it."""
    if not isinstance(source, ModelFile):
        return {"model": source.path.name}
    shipped = {models.path(x).resolve(): f"{PRETRAINED}/{x}" for x in models.names()}
    refit = _training(models.about(source.path)).get("refit")
    return {"model": shipped.get(source.path, source.path.name), "refit": refit}


def called(env: str) -> str:
    """Returns what the file of a model or a policy calls a robot."""
    return rundir.label(env) if user_files.is_file(env) else env


def robot_of(model: Model, said: str, env: str | None) -> str:
    """Returns of which robot a model is: what the command line says, or the file.

    Raises:
      UsageError: if neither says, or the robot is of a file that only the model names,
        or that it does not name.
    """
    name = env or model.about.get("environment")
    if not isinstance(name, str):
        raise UsageError(f"--env is missing; {said} does not say of which robot it is.")
    name = user_files.named("--env", env, name, model.path)
    if env is None and "/" not in name:  # all names of the library's have one
        own = f"{said} is of {name}, which is no robot of the library"
        raise UsageError(f"--env is missing; {own}. Name the file that makes it.")
    return name


def check_fits(model: Model, robot: Any, said: str) -> None:
    """Refuses a model of another robot.

    Raises:
      UsageError: if its sizes or its entries are not those of the robot.
    """
    space = model.ensemble.space
    assert space is not None
    found = (model.ensemble.obs_size, model.ensemble.action_size)
    wanted = robots.sizes(robot)
    own, its = space.coordinates, robot.space.coordinates
    same = own == its and (own or space == robot.space)
    if found == wanted and same:
        return
    why = f"it has observations and actions of {found}, and the robot of {wanted}"
    if found == wanted:
        why = "the coordinates must be the same in the same order; "
        why += unlike(own, its, "the file", lambda x: x.name)
    valid = f"{said} is of another robot: {why}"
    raise UsageError(f"--env {robot.name} is not valid; {valid}.")


def search_of(model: Model, said: str, default: PlannerConfig) -> PlannerConfig:
    """Returns the search that a file says is good for its model.

    Args:
      model: of the file.
      said: what the user called it.
      default: where it says none, with as many particles as there are members.

    Raises:
      CheckpointError: if what it says is none, or has numbers beyond reason.
    """
    if "search" not in model.about:
        members = model.ensemble.num_members
        return dataclasses.replace(default, num_particles=members)
    search = model.about["search"]
    try:
        if not isinstance(search, dict):
            raise TypeError("it says no search")
        own = dict(search.get("settings", {}))
        own |= {x: search[x] for x in ("optimizer", "num_particles")}
        return msgspec.convert(own | {"precision": "f32"}, PlannerConfig)
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{said} cannot be planned with ({error}).") from error


def config_of(path: Path, config: Config) -> Config:
    """Returns what a run with this model would have been started with.

    What the file does not say is that of the preset `laptop`: a task is performed
    once, and planned with the file's own search. A policy learns from what its planner
    does, as a file has no data, so that it performs five times.

    Args:
      path: of the file.
      config: of the command line, with the robot or the arm if they are of files.

    Raises:
      RunError: if the file cannot be read, or says what cannot be.
    """
    said = str(path)
    model = read(path, said)
    own = config.env if user_files.is_file(config.env) else None
    env = robot_of(model, said, own)
    training = _training(model.about)
    arm = _arm_of(model, config.arm)
    given = {"seeds": [training.get("seed", 0)], "env": env, "arm": arm}
    for name in ("num_trials", "trial_length"):
        given |= {name: training[name]} if name in training else {}
    if length := given.get("trial_length"):
        given["task_length"] = length
    default, sizes = preset_config("laptop", arm, env), _sizes(model, said)
    search = search_of(model, said, default.task_planner)
    own_config = dataclasses.replace(
        from_json(given, default, said),
        engine="mujoco",
        eval_trials=5 if config.phase == "distill" else 1,
        model=sizes,
        refit=dataclasses.replace(default.refit, num_epochs=0),  # as it performed
        planner=search,
        task_planner=search,
    )
    check_fits(model, robots.of(own_config), said)
    return own_config


def _training(about: Mapping[str, Any]) -> Mapping[str, Any]:
    training = about.get("training")
    return training if isinstance(training, dict) else {}


def _arm_of(model: Model, given: str) -> str:
    """Returns the arm that explored; one of a user's file is known by its label.

    Raises:
      UsageError: if it is of a file that the command line does not name.
    """
    said = str(_training(model.about).get("arm", given))
    if said == rundir.label(given):
        return given
    try:
        arm = from_json({"arm": said}, Config(), str(model.path)).arm
    except CheckpointError as error:
        words = f"{model.path} was explored by an arm of its own, {said!r}"
        raise UsageError(f"--arm is missing; {words}: name its file.") from error
    return user_files.named("--arm", given, arm, model.path)


def _sizes(model: Model, said: str) -> ModelConfig:
    """Returns the network of an ensemble whose hidden layers are equal."""
    config = model.ensemble.config
    assert config is not None
    widths = config.hidden_sizes
    if len({*widths}) > 1:
        raise UsageError(f"{said} has hidden layers of several widths: {widths}.")
    return ModelConfig(
        config.num_members, widths[0], len(widths), cast(Any, config.activation),
        config.state_margin,
    )  # fmt: skip

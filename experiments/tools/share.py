"""`python -m experiments.tools.share RUN FILE`: a run's model as one file.

What `jaxpets.load_model` reads, with the numbers that the run performs with, and a card
beside it. The files of `jaxpets.pretrained` were written by this, from
`experiments/pretrained`.
"""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jaxpets

from .. import exploration
from ..config import Config, PlannerConfig
from ..errors import RunError
from ..storage import disk, rundir
from ..storage.folder import RunFolder
from . import card

_ALL = ("horizon", "num_samples", "num_iterations")
_SETTINGS = {
    "cem": (*_ALL, "num_elites", "momentum", "legacy_variance"),
    "icem": (*_ALL, "num_elites", "momentum", "noise_beta"),
    "mppi": (*_ALL, "temperature"),
}


def share(
    run: Path, path: Path, *, seed: int | None, env: str | None, licence: str
) -> None:
    """Writes the model of an exploration run to one file.

    Args:
      run: folder of the run.
      path: of the file.
      seed: which of the run's; None for the first.
      env: the robot, which must be said if it is of a file.
      licence: of the file.

    Raises:
      RunError: if the run has no checkpoint or not that seed, or its robot is of a
        file that nobody named.
    """
    found = exploration.explored(run, seed=seed, env=env)
    config = found.config
    about = {
        "environment": config.env if env is None else rundir.label(env),
        "licence": licence,
        "training": _training(RunFolder(run), config, found.seed, found.trial),
        "search": _search(config.task_planner),
    }
    model = _as_performed(found.parts.model, config)
    jaxpets.save_model(path, model, found.params, about=about)


def _as_performed(model: jaxpets.Ensemble, config: Config) -> jaxpets.Ensemble:
    """Returns the ensemble in the precision in which tasks are planned."""
    assert model.config is not None and model.space is not None
    precision = jaxpets.Precision(config.task_planner.precision)
    return jaxpets.ensemble(
        dataclasses.replace(model.config, precision=precision),
        model.space,
        obs_size=model.obs_size,
        action_size=model.action_size,
    )


def _training(
    folder: RunFolder, config: Config, seed: int, trial: int
) -> dict[str, Any]:
    performed = folder.find_json(f"performed-{rundir.CONFIG}")
    return {
        "arm": rundir.label(config.arm),
        "seed": seed,
        "num_trials": trial,
        "trial_length": config.trial_length,
        "refit": performed.get("refit"),
        "software": folder.find_json(rundir.ENVIRONMENT),
    }


def _search(planner: PlannerConfig) -> dict[str, Any]:
    """Returns which search it is, its keyword arguments, and the particles."""
    names = _SETTINGS[planner.optimizer]
    return {
        "optimizer": planner.optimizer,
        "settings": {name: getattr(planner, name) for name in names},
        "num_particles": planner.num_particles,
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Shares a model; returns the exit code, as `experiments.run`."""
    parser = argparse.ArgumentParser(prog=f"{__package__}.share", description=__doc__)
    parser.add_argument("run", type=Path, help="folder of an exploration run")
    parser.add_argument("file", type=Path, help="as model.safetensors")
    parser.add_argument("--seed", type=int, help="by default the run's first")
    parser.add_argument("--env", help="the robot of the run, if it is of a file")
    parser.add_argument("--licence", default="Apache-2.0", help="of the file")
    words = "zero-shots with it, for its card; by default those in the run's folder"
    parser.add_argument("--returns", type=Path, nargs="+", metavar="DIR", help=words)
    args = parser.parse_args(argv)
    options = {"env": args.env, "licence": args.licence}
    try:
        share(args.run, args.file, seed=args.seed, **options)
        said = card.text(args.file, args.run, args.returns)
    except RunError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    disk.write(page := args.file.with_suffix(".md"), said.encode())
    print(f"wrote {args.file} and {page}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

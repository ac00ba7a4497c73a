"""`python -m experiments.tools.share RUN FILE`: a run's model as one file.

What `jaxpets.load_model` reads, with a search that two cores are quick enough for, and
a card beside it. RUN is the folder of an exploration, or of a zero-shot in it, whose
model is that after the refit. The files of `jaxpets.pretrained` were written by this.
"""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jaxpets

from .. import exploration, model_file
from ..config import PlannerConfig
from ..errors import RunError, UsageError, storage_errors
from ..presets import quick_search
from ..storage import disk
from ..storage.folder import RunFolder
from . import card

_ALL = ("horizon", "num_samples", "num_iterations")
_SETTINGS = {
    "cem": (*_ALL, "num_elites", "momentum", "legacy_variance"),
    "icem": (*_ALL, "num_elites", "momentum", "noise_beta"),
    "mppi": (*_ALL, "temperature"),
}


def share(
    run: Path, path: Path, *, seed: int | None, env: str | None, licence: str,
    half: bool = False,
) -> None:  # fmt: skip
    """Writes the model of a run to one file.

    Args:
      run: folder of an exploration, or of a zero-shot in it.
      path: of the file.
      seed: which of the run's; None for the first.
      env: the robot, which must be said if it is of a file.
      licence: of the file.
      half: whether weights are rounded to float16.

    Raises:
      RunError: if the run is of another phase, or has no checkpoint or not that seed,
        or its robot is of a file that nobody named.
    """
    phase = exploration.config_of(RunFolder(run)).phase
    if phase not in ("explore", "zero-shot"):
        raise UsageError(f"{run} is of {phase}; share an exploration, or a zero-shot.")
    found = exploration.explored(run, seed=seed, env=env)
    config = found.config
    search = quick_search(config)
    about = {
        "environment": model_file.called(config.env),
        "licence": licence,
        "training": model_file.training(
            RunFolder(run), config, found.seed, found.trial
        ),
        "search": _search(search),
    } | ({"weights": "float16"} if half else {})
    model = _planned_with(found.parts.model, search)
    jaxpets.save_model(path, model, found.params, about=about, half=half)


def _planned_with(model: jaxpets.Ensemble, search: PlannerConfig) -> jaxpets.Ensemble:
    """Returns the ensemble in the precision in which tasks are planned."""
    assert model.config is not None and model.space is not None
    precision = jaxpets.Precision(search.precision)
    return jaxpets.ensemble(
        dataclasses.replace(model.config, precision=precision),
        model.space,
        obs_size=model.obs_size,
        action_size=model.action_size,
    )


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
    words = "folder of an exploration, or of a zero-shot in it"
    parser.add_argument("run", type=Path, help=words)
    parser.add_argument("file", type=Path, help="as model.safetensors")
    parser.add_argument("--seed", type=int, help="by default the run's first")
    parser.add_argument("--env", help="the robot of the run, if it is of a file")
    words = "round the weights to float16: a file of half the size"
    parser.add_argument("--half", action="store_true", help=words)
    parser.add_argument("--licence", default="Apache-2.0", help="of the file")
    words = "zero-shots with it, for its card; by default those in the run's folder"
    parser.add_argument("--returns", type=Path, nargs="+", metavar="DIR", help=words)
    args = parser.parse_args(argv)
    page = args.file.with_suffix(".md")
    options = {"env": args.env, "licence": args.licence, "half": args.half}
    try:
        if args.file == page:
            raise UsageError(
                f"{page} is where the card goes; call the model otherwise."
            )
        if args.file.is_dir():
            raise UsageError(f"{args.file} is a folder; name a file in it.")
        with storage_errors(f"write {args.file}"):
            args.file.parent.mkdir(parents=True, exist_ok=True)
        # Neither is there without the other, whatever the card fails at.
        with disk.replaced(args.file) as draft:
            share(args.run, draft, seed=args.seed, **options)
            said = card.text(draft, args.run, args.returns, args.file)
            disk.write(page, said.encode())
    except RunError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    print(f"wrote {args.file} and {page}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

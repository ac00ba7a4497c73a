"""`python -m experiments.pretrained RUN NAME`: ships an explored model with the code.

Of a run are kept its config, environment and log, and of its last checkpoint the model
alone: enough for `--phase zero-shot --from pretrained/NAME`, not to learn on. Tasks are
planned with the numbers of the preset `laptop` and a longer horizon, one trial each, so
that a laptop is enough; flags bring back the run's own.
"""

import argparse
import dataclasses
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments import checkpoint, cli, phases, rundir
from experiments.build import build
from experiments.config import PRESETS
from experiments.errors import RunError, UsageError


def ship(run: Path, name: str) -> Path:
    """Writes the model of an exploration run to `results/pretrained/NAME`.

    Raises:
      RunError: if the run has no checkpoint, or there is a model of that name.
    """
    rundir.check_name(name)
    folder = cli.PRETRAINED / name
    if folder.exists():
        raise UsageError(f"there is a model in {folder} already; remove it first.")
    config = cli.from_json(rundir.read_json(run / "config.json"), PRESETS["smoke"])
    template = phases.model_of(phases.explored_template(config, build(config)))
    found = checkpoint.restore(run / "checkpoints", template, part=True, warn=print)
    if found is None:
        raise UsageError(f"there is no checkpoint in {run}.")
    step, state, _ = found
    planner = dataclasses.replace(PRESETS["laptop"].task_planner, horizon=20)
    shipped = dataclasses.replace(
        config, out=Path("runs"), eval_trials=1, task_planner=planner
    )
    checkpoint.save(folder / "checkpoints", step, state, {}, finite=state)
    rundir.write_json(folder / "config.json", cli.to_json(shipped))
    for file in ("env.json", "metrics.jsonl"):
        shutil.copyfile(run / file, folder / file)
    return folder


def main(argv: Sequence[str] | None = None) -> int:
    """Ships a model; returns the exit code, as `experiments.run`."""
    parser = argparse.ArgumentParser(prog="experiments.pretrained", description=__doc__)
    parser.add_argument("run", type=Path, help="folder of an exploration run")
    parser.add_argument("name", help="what --from pretrained/NAME will call it")
    args = parser.parse_args(argv)
    try:
        print(f"wrote {ship(args.run, args.name)}")
    except RunError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())

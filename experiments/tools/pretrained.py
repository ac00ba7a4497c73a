"""`python -m experiments.tools.pretrained RUN NAME`: ships an explored model.

Of a run are kept its config, environment and log, the model that performed in its last
zero-shot, and config and environment of that: enough for `--phase zero-shot --from
pretrained/NAME`, not to learn on. Tasks are planned with the numbers of the preset
`laptop` and a longer horizon, a trial each, so that a laptop is enough; flags bring the
run's own back.
"""

import argparse
import dataclasses
import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import jax

from experiments import cli, phases
from experiments.build import build
from experiments.config import Config
from experiments.entries import from_json, to_json
from experiments.errors import RunError, UsageError
from experiments.presets import PRESETS, PRETRAINED_PLANNER
from experiments.report import logs
from experiments.storage import checkpoint, rundir


def ship(run: Path, name: str, seed: int | None = None) -> Path:
    """Writes the model of an exploration run to `results/pretrained/NAME`.

    Args:
      run: folder of an exploration run that has performed.
      name: of the model.
      seed: which of the run's; by default the first.

    Raises:
      RunError: if the run has not performed, does not have that seed, or there is a
        model of that name.
    """
    rundir.check_name(name)
    folder = cli.PRETRAINED / name
    if folder.exists():
        raise UsageError(f"there is a model in {folder} already; remove it first.")
    config = from_json(rundir.read_json(run / "config.json"), PRESETS["smoke"])
    seed = config.seeds[0] if seed is None else seed
    if seed not in config.seeds:
        valid = ", ".join(map(str, config.seeds))
        raise UsageError(f"--seed {seed} is not valid; it must be one of {valid}.")
    performed, step, state = _performed(run, config)
    i = config.seeds.index(seed)
    state = jax.tree.map(lambda x: x[i : i + 1], state)
    shipped = dataclasses.replace(
        config,
        out=Path("runs"),
        seeds=(seed,),
        eval_trials=1,
        refit=dataclasses.replace(config.refit, num_epochs=0),  # as it performed
        task_planner=PRETRAINED_PLANNER,
    )
    checkpoint.save(folder / "checkpoints", step, state, {}, finite=state)
    rundir.write_json(folder / "config.json", to_json(shipped))
    shutil.copyfile(run / "env.json", folder / "env.json")
    for file in ("config.json", "env.json"):  # how the model came to be what it is
        shutil.copyfile(performed / file, folder / f"performed-{file}")
    rows = (run / "metrics.jsonl").read_text().splitlines()
    rundir.append_rows(
        folder / "metrics.jsonl",
        [row for row in map(json.loads, rows) if row["seed"] == seed],
    )
    return folder


def _performed(run: Path, config: Config) -> tuple[Path, int, phases.State]:
    """Returns the folder of the last zero-shot, its trial, and the model `[S]` of it.

    That of all tasks and without a tag, if there is one.
    """
    folders = run.glob("zero-shot-*")
    performed = [
        folder for folder in folders if checkpoint.steps(folder / "checkpoints")
    ]
    if not performed:
        raise UsageError(f"{run} has not performed; run --phase zero-shot first.")
    last = max(performed, key=_rank)
    template = phases.model_of(phases.explored_template(config, build(config)))
    found = checkpoint.restore(last / "checkpoints", template, warn=print)
    assert found is not None
    return last, *found[:2]


def _rank(folder: Path) -> tuple[int, bool, bool, str]:
    """Orders zero-shots: by trials explored, without a tag, of all tasks."""
    config = logs.read_json(folder / "config.json")
    step = checkpoint.steps(folder / "checkpoints")[-1]
    return step, not config.get("tag"), config.get("task") == "all", folder.name


def main(argv: Sequence[str] | None = None) -> int:
    """Ships a model; returns the exit code, as `experiments.run`."""
    parser = argparse.ArgumentParser(
        prog="experiments.tools.pretrained", description=__doc__
    )
    parser.add_argument("run", type=Path, help="folder of an exploration run")
    parser.add_argument("name", help="what --from pretrained/NAME will call it")
    parser.add_argument("--seed", type=int, help="by default the run's first")
    args = parser.parse_args(argv)
    try:
        print(f"wrote {ship(args.run, args.name, args.seed)}")
    except RunError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())

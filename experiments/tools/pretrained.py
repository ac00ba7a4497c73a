"""`python -m experiments.tools.pretrained RUN NAME`: ships an explored model.

It keeps config, environment and log of a run, the model that performed in its last
zero-shot, and config and environment of that: enough for `zero-shot --from
pretrained/NAME`, but not to learn on. Each task is then one trial, planned with the
numbers of the preset `laptop` and a longer horizon, so that a laptop is enough. Flags
bring the run's own back.
"""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

import jax

from .. import cli, exploration, user_files
from ..build import State, build
from ..config import Config
from ..entries import to_json
from ..errors import RunError, UsageError
from ..presets import PRETRAINED_DISTILL, PRETRAINED_PLANNER
from ..storage import disk, metrics, rundir
from ..storage.folder import RunFolder


def ship(run: Path, name: str, seed: int | None = None) -> Path:
    """Writes the model of an exploration run to `experiments/pretrained/NAME`.

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
    config = exploration.config_of(RunFolder(run))
    if own := [x for x in (config.env, config.arm) if user_files.is_file(x)]:
        raise UsageError(f"{run} needs {own[0]}, which does not come with the code.")
    seed = config.seeds[0] if seed is None else seed
    if seed not in config.seeds:
        valid = ", ".join(map(str, config.seeds))
        raise UsageError(f"--seed {seed} is not valid; it must be one of {valid}.")
    evaluated, step, state = _evaluated(run, config)
    i = config.seeds.index(seed)
    state = jax.tree.map(lambda x: x[i : i + 1], state)
    shipped = dataclasses.replace(
        config,
        out=Path("runs"),
        seeds=(seed,),
        eval_trials=1,
        refit=dataclasses.replace(config.refit, num_epochs=0),  # as it performed
        task_planner=PRETRAINED_PLANNER,
        distill=PRETRAINED_DISTILL,
    )
    model = RunFolder(folder)
    model.save(step, state)
    model.write_json(rundir.CONFIG, to_json(shipped))
    origins = {rundir.ENVIRONMENT: run / rundir.ENVIRONMENT}
    for file in (rundir.CONFIG, rundir.ENVIRONMENT):  # how it came to be what it is
        origins[f"performed-{file}"] = evaluated.path / file
    for file, origin in origins.items():
        disk.write(folder / file, origin.read_bytes())
    rows = metrics.read(run / rundir.METRICS, to_json(config))
    model.log([row.data for row in rows if row.seed == seed])
    return folder


def _evaluated(run: Path, config: Config) -> tuple[RunFolder, int, State]:
    """Returns the folder of the last zero-shot, its trial, and the model `[S]` of it.

    That of all tasks and without a tag, if there is one.
    """
    folders = map(RunFolder, run.glob("zero-shot-*"))
    evaluated = [folder for folder in folders if folder.steps()]
    if not evaluated:
        raise UsageError(f"{run} has not performed; run --phase zero-shot first.")
    last = max(evaluated, key=_rank)
    template = exploration.model_of(exploration.template(config, build(config)))
    found = last.restore(template, part=True)  # without the critic, if it had one
    assert found is not None
    return last, *found


def _rank(folder: RunFolder) -> tuple[int, bool, bool, str]:
    """Orders zero-shots: by trials explored, without a tag, of all tasks."""
    config = rundir.find_json(folder.path / rundir.CONFIG)
    every = config.get("task") == "all"
    return folder.steps()[-1], not config.get("tag"), every, folder.path.name


def main(argv: Sequence[str] | None = None) -> int:
    """Ships a model; returns the exit code, as `experiments.run`."""
    parser = argparse.ArgumentParser(
        prog=f"{__package__}.pretrained", description=__doc__
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

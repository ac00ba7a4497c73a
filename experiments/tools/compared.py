"""Models of several exploration runs, each scored on what all the runs saw."""

import argparse
import functools
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxpets

from .. import exploration
from ..build import State, build
from ..config import Config
from ..entries import to_json
from ..errors import RunError, UsageError
from ..storage import metrics, rundir
from ..storage.folder import RunFolder


class Saved(NamedTuple):
    """What a run had seen after one of its trials."""

    run: Path
    config: Config
    trial: int
    dataset: jaxpets.typing.Dataset  # data [S, C, *]
    first: int  # row after the random trials, which all arms share


class Explored(NamedTuple):
    """The models of a run after one of its trials, and a draw of what they saw."""

    config: Config
    arm: str
    model: jaxpets.Ensemble
    params: jaxpets.EnsembleParams  # [S]
    data: jaxpets.Transition  # [S, B, ...]
    trial: int


def read(
    runs: Sequence[Path], at_trial: int | None, env: str | None,
    draw_fn: Callable[[Saved], jaxpets.Transition],
) -> list[Explored]:  # fmt: skip
    """Returns the models of runs that can be compared, and a draw of what they saw.

    Args:
      runs: folders of exploration runs of one preset, no seed of an arm twice.
      at_trial: whose checkpoints to read; None for the last of each run.
      env: the robot, which must be said if it is of a file.
      draw_fn: draws `[S, B, ...]`, from row `first` on.

    Raises:
      RunError: if the runs cannot be compared or read.
    """
    configs = [exploration.config_of(RunFolder(run)) for run in runs]
    labels = [_label(config) for config in configs]
    _check_comparable(runs, configs, labels)
    configs = [
        exploration.without_files(config, env, run)
        for config, run in zip(configs, runs, strict=True)
    ]
    # The random trials of a seed are the same in all arms: all models know them.
    shared = max(config.random_trials for config in configs)
    found: list[Explored] = []
    for run, config, arm in zip(runs, configs, labels, strict=True):
        model, trial, state = _restored(run, config, at_trial)
        first = shared * config.trial_length
        data = draw_fn(Saved(run, config, trial, state.dataset, first))
        found.append(Explored(config, arm, model, state.params, data, trial))
    return found


def _label(config: Config) -> str:
    return metrics.arm_label(config.arm, to_json(config))


def _check_comparable(
    runs: Sequence[Path], configs: Sequence[Config], labels: Sequence[str]
) -> None:
    """Refuses runs of several presets, and a seed of an arm that is there twice."""
    presets = sorted({rundir.study(to_json(config)) for config in configs})
    if len(presets) > 1:
        raise UsageError(f"the runs are of presets {', '.join(presets)}; give one.")
    seen: dict[tuple[str, int], Path] = {}
    for run, config, arm in zip(runs, configs, labels, strict=True):
        for seed in config.seeds:
            if (arm, seed) in seen:
                raise UsageError(
                    f"{seen[arm, seed]} and {run} both hold seed {seed} of arm {arm}; "
                    "leave one of them out."
                )
            seen[arm, seed] = run


def _restored(
    run: Path, config: Config, at_trial: int | None
) -> tuple[jaxpets.Ensemble, int, State]:
    """Returns the model, the trial that was asked for, and what was saved after it."""
    parts = build(config)
    saved = exploration.as_saved(config, parts)

    def template(leaves: Mapping[str, Any]) -> State:
        whole = saved(leaves)
        return exploration.model_of(whole)._replace(dataset=whole.dataset)

    folder = RunFolder(run)
    if at_trial is None:
        found = folder.restore(template, part=True)
    else:
        found = at_trial, folder.restore_trial(at_trial, template, part=True)
    if found is None:
        raise UsageError(f"there is no checkpoint in {run}.")
    return parts.model, *found


def score_all(
    found: Sequence[Explored], score_fn: Callable[..., Any], *inputs: Any
) -> Any:
    """Returns `score_fn(model, params [S], *inputs)` of all, in NumPy, `[M, ...]`.

    One run after the other; a program is compiled per size of network.
    """
    programs: dict[Any, Any] = {}  # runs with networks of one size share one
    scores = []
    for run in found:
        program = jax.jit(functools.partial(score_fn, run.model))
        program = programs.setdefault(run.config.model, program)
        scores.append(jax.device_get(program(run.params, *inputs)))
    return jax.tree.map(lambda *x: np.concatenate(x), *scores)


def joined(found: Sequence[Explored]) -> jaxpets.Transition:
    """Returns the draws of all runs, `[N, B, ...]`."""
    return jax.tree.map(lambda *x: jnp.concatenate(x), *(run.data for run in found))


def scale_of(values: Array) -> Array:
    """Returns the std `[D]` of values `[..., D]`; 1 for what stays as it is."""
    std = jnp.std(values, axis=tuple(range(values.ndim - 1)))
    return jnp.where(std < 1e-6, 1.0, std)


def arms_of(found: Sequence[Explored]) -> list[str]:
    """Returns the arm of each of M models."""
    return [run.arm for run in found for _ in run.config.seeds]


def heading(found: Sequence[Explored], num_rows: int) -> dict[str, Any]:
    """Returns what a file says of the runs: `preset`, `rows` and `trials`."""
    trials: dict[str, dict[int, int]] = {}
    for run in found:
        own = dict.fromkeys(run.config.seeds, run.trial)
        trials.setdefault(run.arm, {}).update(own)
    preset = rundir.study(to_json(found[0].config))
    return {"preset": preset, "rows": num_rows, "trials": trials}


def check_positive(flag: str, value: int) -> None:
    """Refuses a count of nothing."""
    if value < 1:
        raise UsageError(f"{flag} {value} is not valid; it must be 1 or more.")


def check_enough(saved: Saved, num_rows: int, count: int, what: str) -> None:
    """Refuses to draw more of something than each seed of a run has."""
    if count < num_rows:
        raise UsageError(
            f"--rows {num_rows} is not valid; {saved.run} has {max(count, 0)} "
            f"{what} a seed after the random trials, at trial {saved.trial}."
        )


def parser(name: str, description: str | None) -> argparse.ArgumentParser:
    """Returns a parser of the flags of a tool that compares the models of runs."""
    parser = argparse.ArgumentParser(
        prog=f"{__package__}.{name}",
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "runs", type=Path, nargs="+", metavar="RUN", help="folder of an exploration run"
    )
    parser.add_argument(
        "--at-trial", type=int, help="as all runs were after this trial; else the last"
    )
    parser.add_argument("--env", help="the robot of the runs, if it is of a file")
    return parser


def write(out: Path, measure_fn: Callable[[], dict]) -> int:
    """Writes what is measured as JSON; returns the exit code, as `experiments.run`."""
    try:
        if not out.parent.is_dir():
            raise UsageError(f"--out {out} is not valid; there is no such folder.")
        if out.is_dir():
            raise UsageError(f"--out {out} is not valid; it is a folder.")
        rundir.write_json(out, measure_fn())
    except RunError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    print(f"wrote {out}")
    return 0

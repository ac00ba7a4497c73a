"""What exploration saw: a histogram of two quantities of a robot, of every seed.

They are the axes of the robot, on HalfCheetah forward velocity and pitch rate. A
complete exploration run has them in coverage.json: the edges of the bins as
`velocity_edges` and so on, in that order, their `units`, and `counts`, which by seed
holds how many transitions ended in each cell, a row per bin of the first. The outermost
bins are open.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..errors import UsageError
from ..storage import metrics, rundir
from . import logs

if TYPE_CHECKING:  # they bring orbax and mujoco, which a report need not have
    from jaxpets.envs import Axis

    from ..storage.folder import RunFolder

_FILE = "coverage.json"
_EDGES = "_edges"
_FAST_AXES = ["velocity", "pitch_rate"]
_FAST = 3.0  # m/s
_SPIN = 6.0  # rad/s, about a turn a second

Counts = dict[int, np.ndarray]  # seed -> [V, W]


class Scale(NamedTuple):
    """An axis of a histogram; see `jaxpets.envs.Axis`."""

    name: str
    unit: str
    edges: tuple[float, ...]


class Seen(NamedTuple):
    """What the arms of a preset and robot saw."""

    scales: tuple[Scale, Scale]
    by_arm: dict[str, Counts]


class _Found(NamedTuple):
    """The coverage of one run."""

    run: Path
    preset: str  # as in a Row
    arm: str  # as in a Row
    scales: tuple[Scale, Scale]
    counts: Counts


def histogram(axes: Sequence["Axis"], next_obs: np.ndarray) -> np.ndarray:
    """Counts observations `[N, D]` by two of their entries, `[V, W]` int.

    A number on an edge counts above it, one beyond all edges in the outermost bin.
    """
    edges = [np.array([-np.inf, *axis.edges[1:-1], np.inf]) for axis in axes]
    first, second = (next_obs[:, axis.entry] for axis in axes)
    counts, *_ = np.histogram2d(first, second, edges)
    return counts.astype(np.int64)


def write(
    run: "RunFolder", axes: Sequence["Axis"], seeds: Sequence[int], template: Any,
    step: int, *, anew: bool,
) -> None:  # fmt: skip
    """Writes coverage.json of a complete exploration run, from its last checkpoint.

    Args:
      run: where the exploration is.
      axes: two of the robot; nothing is written if it has none.
      seeds: S, in the order of the learner's leading axis.
      template: the dataset of a learner `[S]`, as shapes, and nothing else of it.
      step: the last trial.
      anew: whether to replace the file if it is there.

    Raises:
      CheckpointError, StorageError: if the one cannot be read or the other written.
    """
    found = run.find_json(_FILE)
    if not axes:
        return
    # Of fewer trials where a run that was given more has died just before its end here.
    if found and found.get("trial", step) == step and not anew:
        return
    dataset = run.restore_trial(step, template, part=True).dataset
    filled = np.asarray(dataset.data.next_obs)[:, : int(dataset.size)]
    counts = {
        seed: histogram(axes, next_obs)
        for seed, next_obs in zip(seeds, filled, strict=True)
    }
    edges = {f"{axis.name}{_EDGES}": axis.edges for axis in axes}
    units = [axis.unit for axis in axes]
    about = {**edges, "units": units, "trial": step}
    run.write_json(_FILE, {**about, "counts": counts})


def load(out: Path) -> dict[str, Seen]:
    """Reads every coverage.json under a folder, hidden ones left out.

    Returns:
      What was seen, by preset and robot as `rundir.study` has it.

    Raises:
      UsageError: if a file is no coverage of a run, has other bins than the first, or
        two hold one seed of an arm.
    """
    found: dict[str, Seen] = {}
    runs: dict[tuple[str, str, int], Path] = {}
    for path in logs.files(out, _FILE):
        one = _read(path)
        seen = found.setdefault(one.preset, Seen(one.scales, {}))
        if one.scales != seen.scales:
            raise UsageError(f"{path} has other bins than runs before it; remove it.")
        by_seed = seen.by_arm.setdefault(one.arm, {})
        for seed, counts in one.counts.items():
            first = runs.setdefault((one.preset, one.arm, seed), one.run)
            if first != one.run:
                raise UsageError(
                    f"{first} and {one.run} both hold the coverage of seed {seed}, arm "
                    f"{one.arm}, preset {one.preset}; move one of them elsewhere."
                )
            by_seed[seed] = counts
    return found


def _read(path: Path) -> _Found:
    data = rundir.find_json(path)
    config = logs.config(path.parent)
    try:
        scales = _scales(data)
        counts = {int(seed): np.array(x, int) for seed, x in data["counts"].items()}
        arm, preset = metrics.arm_label(config["arm"], config), rundir.study(config)
    except (
        ArithmeticError,
        LookupError,
        ValueError,
        TypeError,
        AttributeError,
    ) as error:
        raise UsageError(f"{path} is no coverage of a run ({error!r}).") from error
    shape = tuple(len(scale.edges) - 1 for scale in scales)
    if any(x.shape != shape for x in counts.values()):
        raise UsageError(f"{path} has other bins than it says; remove it.")
    return _Found(path.parent, preset, arm, scales, counts)


def _scales(data: Mapping[str, Any]) -> tuple[Scale, Scale]:
    """Returns the two axes of a file; older ones, of HalfCheetah, have no units."""
    names = [name for name in data if name.endswith(_EDGES)]
    edges = [tuple(map(float, data[name])) for name in names]
    units = data.get("units", ("m/s", "rad/s"))
    one, other = (
        Scale(name.removesuffix(_EDGES), str(unit), own)
        for name, unit, own in zip(names, units, edges, strict=True)
    )
    return one, other


def measures(scales: tuple[Scale, Scale], counts: np.ndarray) -> dict[str, float]:
    """Returns what a table says of one histogram `[V, W]`, by the table's columns.

    On HalfCheetah that is also how often it was fast.
    """
    total = counts.sum()
    found = {
        "transitions": float(total),
        "cells seen": float(np.sum(counts >= 1)),
        "cells seen 10 times": float(np.sum(counts >= 10)),
    }
    if [scale.name for scale in scales] != _FAST_AXES:
        return found
    velocity, pitch_rate = counts.sum(axis=1), counts.sum(axis=0)

    def percent(some: np.ndarray) -> float:
        return float(100 * some.sum() / total)

    # An edge belongs to the bin above it: these are `>= _FAST` and `< -_FAST`.
    edges, rates = (np.array(scale.edges) for scale in scales)
    low, high, left, right = edges[:-1], edges[1:], rates[:-1], rates[1:]
    return found | {
        f"forward over {_FAST:g} m/s, %": percent(velocity[low >= _FAST]),
        f"backward over {_FAST:g} m/s, %": percent(velocity[high <= -_FAST]),
        f"nose down over {_SPIN:g} rad/s, %": percent(pitch_rate[left >= _SPIN]),
        f"nose up over {_SPIN:g} rad/s, %": percent(pitch_rate[right <= -_SPIN]),
    }

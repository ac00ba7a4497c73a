"""What exploration saw: a histogram of forward velocity by pitch rate of every seed.

A complete exploration run has it in coverage.json: `velocity_edges` in m/s,
`pitch_rate_edges` in rad/s, and `counts`, which by seed holds how many transitions
ended in each cell, a row per bin of velocity. The outermost bins are open.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from experiments.errors import UsageError
from experiments.report import logs
from experiments.storage import metrics, rundir

if TYPE_CHECKING:  # it brings orbax
    from experiments.storage.folder import RunFolder

VELOCITY_EDGES = tuple(i / 2 for i in range(-16, 17))  # m/s
PITCH_RATE_EDGES = tuple(float(i) for i in range(-15, 16))  # rad/s

_FILE = "coverage.json"
_FAST = 3.0  # m/s
_SPIN = 6.0  # rad/s, about a turn a second

Counts = dict[int, np.ndarray]  # seed -> [V, W]


class _Found(NamedTuple):
    """The coverage of one run."""

    run: Path
    preset: str
    arm: str  # as in a Row
    counts: Counts


def histogram(next_obs: np.ndarray) -> np.ndarray:
    """Counts observations `[N, D]` by velocity and pitch rate, `[V, W]` int.

    A number on an edge counts above it, one beyond all edges in the outermost bin.
    """
    # Not above: the report reads coverage also where mujoco cannot be imported.
    from jaxpets.envs import half_cheetah

    edges = [
        np.array([-np.inf, *inner[1:-1], np.inf])
        for inner in (VELOCITY_EDGES, PITCH_RATE_EDGES)
    ]
    velocity = next_obs[:, half_cheetah.FORWARD_VELOCITY]
    pitch_rate = next_obs[:, half_cheetah.PITCH_RATE]
    counts, *_ = np.histogram2d(velocity, pitch_rate, edges)
    return counts.astype(np.int64)


def write(
    run: "RunFolder", seeds: Sequence[int], template: Any, step: int, *, anew: bool
) -> None:
    """Writes coverage.json of a complete exploration run, from its last checkpoint.

    Args:
      run: where the exploration is.
      seeds: S, in the order of the learner's leading axis.
      template: the dataset of a learner `[S]`, as shapes, and nothing else of it.
      step: the last trial.
      anew: whether to replace the file if it is there.

    Raises:
      CheckpointError, StorageError: if the one cannot be read or the other written.
    """
    found = run.find_json(_FILE)
    # Of fewer trials where a run that was given more has died just before its end here.
    if found and found.get("trial", step) == step and not anew:
        return
    dataset = run.restore_trial(step, template, part=True).dataset
    filled = np.asarray(dataset.data.next_obs)[:, : int(dataset.size)]
    counts = {
        seed: histogram(next_obs) for seed, next_obs in zip(seeds, filled, strict=True)
    }
    edges = {"velocity_edges": VELOCITY_EDGES, "pitch_rate_edges": PITCH_RATE_EDGES}
    run.write_json(_FILE, {**edges, "trial": step, "counts": counts})


def load(out: Path) -> dict[str, dict[str, Counts]]:
    """Reads every coverage.json under a folder, hidden ones left out.

    Returns:
      Counts `[V, W]` by preset, arm and seed.

    Raises:
      UsageError: if a file is no coverage of a run, or two hold one seed of an arm.
    """
    found: dict[str, dict[str, Counts]] = {}
    runs: dict[tuple[str, str, int], Path] = {}
    for path in logs.files(out, _FILE):
        one = _read(path)
        by_seed = found.setdefault(one.preset, {}).setdefault(one.arm, {})
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
        edges = tuple(data["velocity_edges"]), tuple(data["pitch_rate_edges"])
        counts = {int(seed): np.array(x, int) for seed, x in data["counts"].items()}
        arm, preset = metrics.arm_label(config["arm"], config), config["preset"]
    except (
        ArithmeticError,
        LookupError,
        ValueError,
        TypeError,
        AttributeError,
    ) as error:
        raise UsageError(f"{path} is no coverage of a run ({error!r}).") from error
    shape = len(VELOCITY_EDGES) - 1, len(PITCH_RATE_EDGES) - 1
    fits = edges == (VELOCITY_EDGES, PITCH_RATE_EDGES)
    if not fits or any(x.shape != shape for x in counts.values()):
        raise UsageError(f"{path} has other bins than this version; remove it.")
    return _Found(path.parent, preset, arm, counts)


def measures(counts: np.ndarray) -> dict[str, float]:
    """Returns what a table says of one histogram `[V, W]`, by the table's columns."""
    total = counts.sum()
    velocity, pitch_rate = counts.sum(axis=1), counts.sum(axis=0)

    def percent(some: np.ndarray) -> float:
        return float(100 * some.sum() / total)

    # An edge belongs to the bin above it: these are `>= _FAST` and `< -_FAST`.
    low, high = np.array(VELOCITY_EDGES[:-1]), np.array(VELOCITY_EDGES[1:])
    left, right = np.array(PITCH_RATE_EDGES[:-1]), np.array(PITCH_RATE_EDGES[1:])
    return {
        "transitions": float(total),
        "cells seen": float(np.sum(counts >= 1)),
        "cells seen 10 times": float(np.sum(counts >= 10)),
        f"forward over {_FAST:g} m/s, %": percent(velocity[low >= _FAST]),
        f"backward over {_FAST:g} m/s, %": percent(velocity[high <= -_FAST]),
        f"nose down over {_SPIN:g} rad/s, %": percent(pitch_rate[left >= _SPIN]),
        f"nose up over {_SPIN:g} rad/s, %": percent(pitch_rate[right <= -_SPIN]),
    }

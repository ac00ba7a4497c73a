"""Seeds, tasks and trials over several devices: the same run, and nothing to say."""

import contextlib
import io
import json
import math
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import runs

from experiments.parallel import devices
from experiments.run import main
from experiments.storage import checkpoint

SCRIPT = Path(__file__).with_name("on_four_devices.py")
TASKS = "zero-shot-003"
ACTOR = "zero-shot-003-actor"


@pytest.mark.parametrize(
    ("counts", "limit", "wanted"),
    [
        ((4, 1, 1), 4, (4, 1, 1)),
        ((1, 4, 5), 4, (1, 4, 1)),
        ((1, 1, 5), 4, (1, 1, 1)),
        ((1, 1, 6), 4, (1, 1, 3)),
        ((2, 4, 1), 4, (2, 2, 1)),
        ((3, 4, 5), 8, (3, 2, 1)),
        ((3, 1, 1), 2, (1, 1, 1)),
        ((16, 4, 5), 8, (8, 1, 1)),
        ((1, 1, 1), 8, (1, 1, 1)),
    ],
)
def test_the_most_equal_parts_seeds_first(counts, limit, wanted):
    found = devices.grid(counts, limit)
    assert found == wanted
    whole = math.prod(counts)
    best = max(d for d in range(1, limit + 1) if whole % d == 0)
    assert math.prod(found) == best
    assert all(c % part == 0 for c, part in zip(counts, found, strict=True))


@pytest.mark.parametrize("axes", [devices.AXES[:1], devices.AXES[:2], devices.AXES])
def test_blocks_of_hosts_make_the_whole_again(axes):
    counts, parts = (4, 6, 5), {"seed": 2, "task": 3, "trial": 1}
    hosts = tuple(parts[axis] if axis in axes else 1 for axis in devices.AXES)
    shape = counts[: len(axes)]
    whole = {
        "rows": np.arange(math.prod(shape) * 2).reshape(*shape, 2),
        "flag": np.arange(math.prod(shape)).reshape(shape) % 3 == 0,
        "size": np.array(7, np.int32),
    }
    spread = devices.spread(*counts)
    blocks = []
    for host in np.ndindex(hosts):
        own = spread._replace(hosts=hosts, host=host)
        blocks.append(devices.block(own, whole, *axes))
    for i, axis in enumerate(axes):
        assert blocks[0]["rows"].shape[i] == counts[i] // parts[axis]
    blocks.append(blocks[0])  # a host too many repeats another's
    every = jax.tree.map(lambda *x: np.stack(x), *blocks)
    found = devices.join(spread._replace(hosts=hosts), every, *axes)
    for name, array in whole.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)


def test_one_device_is_left_as_it_is():
    spread = devices.spread(3, 4)
    tree = {"x": jnp.ones((3, 4, 2)), "size": jnp.int32(1)}
    assert spread.mesh.size == 1 and devices.idle(spread) is None
    assert devices.split(spread, len, None, None) is len
    assert devices.place(spread, tree, "seed", "task")["x"] is tree["x"]
    assert devices.collect(spread, tree, "seed", "task")["x"] is tree["x"]
    assert [devices.each(spread, axis) for axis in devices.AXES] == [3, 4, 1]


# With devices that one CPU pretends to have.


class Runs(NamedTuple):
    """What was run, on how many devices; seeds 3 to 0 unless there is one."""

    alone: Path  # seed 0, one device
    performed: Path  # that and all tasks, one device
    four: Path  # four devices
    four_then_one: Path  # the last trial on one device
    said: str  # by the process with four devices
    then_said: str  # by the one that went on
    seen: dict  # see on_four_devices.py


@pytest.fixture(scope="module")
def found(explored_copy, performed_once, tmp_path_factory):
    out = tmp_path_factory.mktemp("devices")
    alone = explored_copy(0)
    four = out / "four" / runs.NAME
    process = runs.start(SCRIPT, out, alone, devices=4)
    said, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    seen = json.loads(said.splitlines()[-1])
    assert seen["codes"] == [0, 0, 0], errors
    assert seen["devices"] == 4
    four_then_one = runs.unfinished(four, out / "four-one")
    with contextlib.redirect_stderr(io.StringIO()) as then:
        assert runs.explore(four_then_one.parent, *runs.FOUR) == four_then_one
    said = errors, then.getvalue()
    return Runs(alone, performed_once, four, four_then_one, *said, seen)


def close(one, other, **tolerance):
    assert runs.numbers(one) == pytest.approx(runs.numbers(other), **tolerance)


@pytest.mark.slow
def test_a_seed_on_its_device_is_the_seed_alone(found):
    """In every trial; a CPU in four parts sums a little otherwise than a whole one."""
    many = [row for row in runs.rows(found.four) if row["seed"] == 0]
    assert len(many) == runs.LAST
    for row, alone in zip(many, runs.rows(found.alone), strict=True):
        close(row, alone, rel=1e-3, abs=1e-3)
    actions = [
        np.asarray(runs.learner(folder).dataset.data.action)[-1]
        for folder in (found.four, found.alone)
    ]
    np.testing.assert_array_equal(*actions)


@pytest.mark.slow
def test_the_log_of_four_devices_is_in_order(found):
    labels = ("trial", "seed", "steps", "phase", "arm", "planner")
    many, alone = runs.rows(found.four), runs.rows(found.alone)
    assert [[row[name] for name in labels] for row in many] == [
        [row["trial"], seed, *(row[name] for name in labels[2:])]
        for row in alone
        for seed in runs.FOUR
    ]


@pytest.mark.slow
def test_a_run_goes_on_with_another_number_of_devices(found):
    """From the very state that was saved: the older data are there bit for bit."""
    resumed = found.four_then_one
    old = [row for row in runs.rows(found.four) if row["trial"] < runs.LAST]
    assert runs.rows(resumed)[: len(old)] == old
    new = runs.rows(resumed)[len(old) :]
    assert [(row["seed"], row["trial"]) for row in new] == [(s, 3) for s in runs.FOUR]
    assert checkpoint.steps(resumed / "checkpoints")[-1] == runs.LAST
    before, after = runs.learner(found.four, runs.LAST - 1), runs.learner(resumed)
    known = runs.STEPS * (runs.LAST - 1)
    assert int(before.dataset.size) == known
    assert int(after.dataset.size) == known + runs.STEPS
    for a, b in zip(before.dataset.data, after.dataset.data, strict=True):
        np.testing.assert_array_equal(a[:, :known], b[:, :known])
    assert "device_count was 4 and is now 1" in found.then_said


@pytest.mark.slow
def test_tasks_of_one_seed_are_spread(found):
    """Restored from a run on one device and refit; the same returns as there."""
    assert found.seen["tasks"] == [1, 4, 1]
    spread, here = found.alone / TASKS, found.performed / TASKS
    for row, other in zip(runs.rows(spread), runs.rows(here), strict=True):
        assert row["task"] == other["task"]
        close(row, other, rel=1e-2, abs=1e-2)
    paths = [np.load(folder / "trajectories.npz") for folder in (spread, here)]
    assert paths[0]["obs"].shape == paths[1]["obs"].shape == (1, 4, 1, runs.STEPS, 18)


@pytest.mark.slow
def test_the_actors_of_tasks_are_spread(found, tmp_path):
    """A task a device: what its actor learns, and then earns, is as on one device."""
    here = tmp_path / runs.NAME
    shutil.copytree(found.alone, here)
    shutil.rmtree(here / ACTOR)
    assert main(["--phase", "zero-shot", "--from", str(here), *runs.ACTOR]) == 0
    for row, other in zip(
        runs.rows(found.alone / ACTOR), runs.rows(here / ACTOR), strict=True
    ):
        assert row["task"] == other["task"]
        close(row, other, rel=1e-2, abs=1e-2)


@pytest.mark.slow
def test_devices_have_nothing_to_say_to_each_other(found):
    assert found.seen["acting"] == {"devices": 4, "communication": []}


@pytest.mark.slow
def test_what_cannot_be_spread_evenly_is_said(found):
    line = "using 3 of 4 devices; 3 seeds cannot be spread over more in equal parts."
    assert found.seen["idle"] == line
    assert "cannot be spread" not in found.said


@pytest.mark.slow
def test_one_plan_over_four_devices(found):
    """One all-gather; all agree, and find what one device does with four parts."""
    plan = found.seen["plan"]
    assert plan["communication"] == ["all-gather"]
    assert plan["shards"] == 4 and plan["spread"] == 0.0
    assert plan["difference"] < 1e-4


@pytest.mark.slow
def test_the_benchmark_of_scaling(found):
    rows = found.seen["benchmark"]
    names = [(row["benchmark"], row["sizes"]["devices"]) for row in rows]
    assert names == [("scale-seeds", 2), ("scale-candidates", 2)]  # there are no 64
    for row in rows:
        assert row["difference"] < 1e-4
        assert min(row[name] for name in ("one_ms", "all_ms", "efficiency")) > 0
    assert rows[1]["sizes"]["num_samples"] == 16 * rows[0]["sizes"]["num_samples"]


def test_the_fullest_device_tells_what_arrays_take(monkeypatch):
    said = [{"bytes_in_use": 3}, None, {"bytes_in_use": 7}, {}]
    found = [SimpleNamespace(memory_stats=lambda x=x: x) for x in said]
    monkeypatch.setattr(devices.jax, "local_devices", lambda: found)
    assert devices.bytes_in_use() == 7
    monkeypatch.setattr(devices.jax, "local_devices", lambda: found[1:2])
    assert devices.bytes_in_use() is None

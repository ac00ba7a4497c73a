"""Checkpoints: what was saved comes back, or a message says why not."""

import gc
import json
import os
import subprocess
import weakref
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from states import as_bytes, fail, make_state, restore, save_two

from experiments.errors import CheckpointError, DivergedError
from experiments.storage import checkpoint, pytrees
from experiments.storage.step_folders import SEAL


@pytest.fixture
def directory(tmp_path) -> Path:
    return save_two(tmp_path / "checkpoints")


# What was saved comes back.


@pytest.mark.parametrize("abstract", [False, True])
def test_round_trip_is_bitwise_and_silent(tmp_path, capfd, abstract):
    state = make_state(3)
    meta = {"log": 120, "best": 0.1, "names": ["a", None]}
    checkpoint.save(tmp_path / "new" / "checkpoints", 3, state, meta)
    template = jax.eval_shape(lambda: make_state(0)) if abstract else make_state(0)
    found = checkpoint.restore(tmp_path / "new" / "checkpoints", template, warn=fail)
    assert found is not None
    step, restored, restored_meta = found
    assert (step, restored_meta) == (3, meta)
    assert jax.tree.structure(restored) == jax.tree.structure(state)
    assert as_bytes(restored) == as_bytes(state)
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(restored))
    assert capfd.readouterr() == ("", "")


def test_restored_arrays_live_where_the_template_says(directory):
    device = jax.devices()[0]
    pinned = jax.sharding.SingleDeviceSharding(device)
    template = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=pinned),
        make_state(0),
    )
    (_, state, _), _ = restore(directory, template)
    assert state.params.w1.committed
    assert state.params.w1.sharding == pinned
    (_, state, _), _ = restore(directory, make_state(0))
    assert not state.params.w1.committed


def test_nothing_to_restore(tmp_path):
    assert restore(tmp_path / "absent") == (None, [])
    (tmp_path / ".saving-3").mkdir()
    (tmp_path / "notes.txt").write_text("mine")
    assert restore(tmp_path) == (None, [])
    assert checkpoint.steps(tmp_path) == []


def test_a_reader_of_a_run_that_goes_on_takes_what_is_newest(tmp_path, monkeypatch):
    """The step that it chose is dropped as it reads, and the run has another by now."""
    read, later = checkpoint._read, [2]

    def slowly(*args):
        for step in [later.pop()] if later else []:
            checkpoint.save(tmp_path, step, make_state(step), {}, keep=1)
        return read(*args)

    checkpoint.save(tmp_path, 1, make_state(1), {}, keep=1)
    monkeypatch.setattr(checkpoint, "_read", slowly)
    found = checkpoint.restore(tmp_path, make_state(0), warn=fail)
    assert found is not None and found[0] == 2
    assert as_bytes(found[1]) == as_bytes(make_state(2))


def test_a_given_step(directory):
    found, warnings = restore(directory, step=1)
    assert found[0] == 1
    assert warnings == []
    assert checkpoint.steps(directory) == [1, 2]
    with pytest.raises(CheckpointError, match=r"no checkpoint 7 in .*there: 1, 2"):
        restore(directory, step=7)
    (directory / "2" / SEAL).unlink()
    with pytest.raises(CheckpointError, match=r"checkpoint 2 .*damaged.*there: 1\)"):
        restore(directory, step=2)
    assert (directory / "2").exists()


def test_a_state_must_be_jax_arrays_with_distinct_names(tmp_path):
    with pytest.raises(TypeError, match=r"a/0 is a float, want a jax array"):
        checkpoint.save(tmp_path, 1, {"a": [1.0]}, {})
    clash = {"a": {"b": jnp.ones(2)}, "a/b": jnp.ones(3)}
    with pytest.raises(ValueError, match="'a/b'"):
        checkpoint.save(tmp_path, 1, clash, {})
    with pytest.raises(ValueError, match="not JSON compliant"):
        checkpoint.save(tmp_path, 1, {"a": jnp.ones(2)}, {"loss": float("nan")})
    assert list(tmp_path.iterdir()) == []


# Which steps stay.


def test_keep_and_milestones(tmp_path):
    state = {"w": jnp.ones(3)}
    for step in range(1, 7):
        checkpoint.save(tmp_path, step, state, {}, keep=2, milestones=(2, 3))
        assert step in checkpoint.steps(tmp_path)
    assert checkpoint.steps(tmp_path) == [2, 3, 5, 6]
    assert sorted(os.listdir(tmp_path)) == ["2", "3", "5", "6"]
    checkpoint.save(tmp_path, 7, state, {}, keep=1)
    assert checkpoint.steps(tmp_path) == [7]
    with pytest.raises(ValueError, match="keep"):
        checkpoint.save(tmp_path, 8, state, {}, keep=0)


def test_nothing_of_a_state_is_held_after_its_save(tmp_path, monkeypatch):
    """A run would grow by a state with every trial: gc looks at old cycles rarely."""
    seen = []

    def to_host(tree):
        arrays = {name: x.copy() for name, x in copied(tree).items()}
        seen.extend(map(weakref.ref, arrays.values()))
        return arrays

    copied = pytrees.to_host
    monkeypatch.setattr(pytrees, "to_host", to_host)
    gc.disable()
    try:
        checkpoint.save(tmp_path, 1, make_state(1), {})
    finally:
        gc.enable()
    assert seen and not any(reference() is not None for reference in seen)


def test_going_on_from_an_older_step(directory):
    with pytest.raises(CheckpointError, match=r"checkpoint 2 would not be the newest"):
        checkpoint.save(directory, 2, make_state(5), {"log": 5})
    (directory / "2").rename(directory / ".moved-2")  # as the message says
    checkpoint.save(directory, 2, make_state(5), {"log": 5})
    found, _ = restore(directory)
    assert as_bytes(found[1]) == as_bytes(make_state(5))
    assert sorted(os.listdir(directory)) == [".moved-2", "1", "2"]


def test_non_finite_parts_are_refused(directory):
    state = make_state(3)
    params = state.params._replace(w1=state.params.w1.at[2, 3].set(jnp.nan))
    bad = state._replace(params=params)
    with pytest.raises(
        DivergedError, match=r"w1: 1 of 2000 .*Last good checkpoint: 2\."
    ):
        checkpoint.save(directory, 3, bad, {}, finite=bad.params)
    assert sorted(os.listdir(directory)) == ["1", "2"]
    checkpoint.save(directory, 3, bad, {}, finite=bad.counts)
    assert checkpoint.steps(directory) == [2, 3]


# Checkpoints of something else.


@pytest.mark.parametrize(
    ("altered", "message"),
    [
        (
            lambda s: s._replace(params=s.params._replace(w1=jnp.ones((40, 51)))),
            r"params/w1 has shape \(40, 50\) \(checkpoint\) vs \(40, 51\) \(now\)",
        ),
        (
            lambda s: s._replace(params=s.params._replace(low=jnp.ones(7))),
            r"params/low has dtype bfloat16 \(checkpoint\) vs float32 \(now\)",
        ),
        (
            lambda s: s._replace(counts={**s.counts, "more": jnp.ones(2)}),
            r"it lacks counts/more\.",
        ),
        (
            lambda s: s._replace(counts={"steps": s.counts["steps"]}),
            r"counts/full is not in this run",
        ),
        (
            lambda s: s._replace(key=jax.random.PRNGKey(0)),
            r"key has key threefry2x32 \(checkpoint\) vs raw \(now\)",
        ),
        (
            lambda s: s._replace(other_key=jax.random.key(0, impl="unsafe_rbg")),
            r"other_key has key rbg \(checkpoint\) vs unsafe_rbg \(now\)",
        ),
        (lambda s: s.params, r"it lacks w1.*; and \d+ more"),
    ],
)
def test_leaves_that_do_not_fit(directory, altered, message):
    with pytest.raises(CheckpointError, match=message) as error:
        restore(directory, altered(make_state(0)))
    assert "checkpoint 2 in" in str(error.value)
    assert "written by jaxpets" in str(error.value)
    assert "\n" not in str(error.value)
    assert checkpoint.steps(directory) == [1, 2]


def test_a_newer_schema(directory, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "SCHEMA", 3)
        checkpoint.save(directory, 3, make_state(3), {})
    with pytest.raises(CheckpointError, match=r"schema 3; this is jaxpets .*schema 2"):
        restore(directory)


def test_the_record_is_plain_json(directory):
    record = json.loads((directory / "2" / "meta" / "metadata").read_text())
    leaf = record["leaves"]["key"]
    assert record["step"] == 2
    assert (leaf["key"], leaf["dtype"], leaf["shape"]) == (
        "threefry2x32",
        "uint32",
        [3, 2],
    )
    sealed = subprocess.run(
        ["sha256sum", "--quiet", "-c", SEAL],
        cwd=directory / "2",
        capture_output=True,
        check=False,
    )
    assert sealed.returncode == 0, sealed.stderr

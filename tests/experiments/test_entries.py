"""A config in a file: what is read back, and what is refused."""

import dataclasses
import functools
import json
from pathlib import Path

import pytest

from experiments.config import Config, Run, part
from experiments.entries import differences, entries, from_json, to_json
from experiments.errors import CheckpointError
from experiments.presets import PRESETS, preset_config
from experiments.storage.rundir import HALF_CHEETAH

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results"


def file_with(name, value):
    """Returns a config in JSON with another value of an entry."""
    data = to_json(Config())
    *groups, last = name.split(".")
    functools.reduce(dict.__getitem__, groups, data)[last] = value
    return data


@pytest.mark.parametrize("preset", PRESETS)
def test_configs_survive_json(preset, tmp_path):
    config = dataclasses.replace(
        PRESETS[preset], phase="finetune", seeds=(1, 2**32 - 1), video=tmp_path / "a"
    )
    data = json.loads(json.dumps(to_json(config)))
    default = dataclasses.replace(PRESETS["paper"], num_trials=7)
    assert from_json(data, default) == config
    del data["num_trials"], data["planner"]["horizon"]
    older = from_json(data, default)
    assert older.num_trials == 7 and older.planner.horizon == default.planner.horizon
    with pytest.raises(CheckpointError, match="unknown entry 'colour'"):
        from_json({**data, "colour": 1}, default)


@pytest.mark.parametrize(
    ("name", "value", "wanted"),
    [
        ("phase", "zzz", "explore, zero-shot, finetune, distill, report"),
        ("preset", "zzz", "laptop, paper, smoke"),
        ("arm", 3, "epistemic, count,"),
        ("env", 3, "text"),
        ("task", 3, "text"),
        ("engine", "zzz", "mjx, mujoco"),
        ("planner.optimizer", "adam", "cem, icem, mppi"),
        ("task_planner.precision", "f16", "f32, tf32, bf16"),
        ("seeds", "abc", "a list, each 0 to 4,294,967,295"),
        ("seeds", [0.5], "a list, each 0 to 4,294,967,295"),
        ("seeds", [True], "a list, each 0 to 4,294,967,295"),
        ("seeds", [-1], "a list, each 0 to 4,294,967,295"),
        ("num_trials", "3", "1 to 100,000"),
        ("num_trials", None, "1 to 100,000"),
        ("num_trials", 0, "1 to 100,000"),
        ("planner.momentum", 1.5, "0.0 to 1.0"),
        ("model.state_margin", -1, "0.0 to 1,000,000.0 or None"),
        ("refit.bootstrap", 1, "true or false"),
        ("out", 3, "a path"),
        ("out", "", "a path"),
        ("model", None, "an object"),
        ("planner", [], "an object"),
    ],
)
def test_what_is_not_valid_is_refused_by_name(name, value, wanted):
    with pytest.raises(CheckpointError) as error:
        from_json(file_with(name, value), Config())
    assert f"config.json: {name} is {value!r}, not {wanted}" in str(error.value)


@pytest.mark.parametrize("data", [[], None, 5, "x"])
def test_a_file_that_is_no_object_is_refused(data):
    with pytest.raises(CheckpointError, match="not an object"):
        from_json(data, Config())
    with pytest.raises(CheckpointError, match="not an object"):
        differences(data, to_json(Config()))


@pytest.mark.parametrize("name", [entry.name for entry in entries(Config)])
def test_no_entry_takes_just_anything(name):
    with pytest.raises(CheckpointError, match=name):
        from_json(file_with(name, {"x": 1}), Config())


@pytest.mark.parametrize("value", ["../../x", "/etc/x", "a\x1b[2J\n", "a\0b"])
def test_what_a_stranger_may_write_is_a_name_or_a_path_or_refused(value):
    """Names and paths are never taken from the folder of a run: see test_cli.py."""
    taken = set()
    for entry in entries(Config):
        try:
            from_json(file_with(entry.name, value), Config())
        except CheckpointError as error:
            assert entry.name in str(error) and str(error).isprintable()
        else:
            taken.add(entry.name)
    texts = {"env", "task", "tasks", "policy", "name", "tag", "coordinator_address"}
    assert taken == texts | {"out", "video", "source"}
    with pytest.raises(CheckpointError) as error:
        from_json({value: 1}, Config(), "runs/x/config.json")
    words = "Use the version that wrote it."
    assert str(error.value).startswith("runs/x/config.json has an unknown entry '")
    assert str(error.value).isprintable() and str(error.value).endswith(words)


@pytest.mark.skipif(not RESULTS.exists(), reason="not in this copy of the code")
def test_all_configs_that_were_ever_committed_can_be_read():
    paths = [
        *sorted(RESULTS.rglob("*config.json")),
        *sorted((ROOT / "experiments").rglob("*config.json")),
    ]
    assert len(paths) >= 4
    for path in paths:
        data = json.loads(path.read_text())
        env = data.get("env", HALF_CHEETAH)
        config = from_json(data, preset_config(data["preset"], data["arm"], env))
        assert {**to_json(config), **data}.keys() == to_json(config).keys(), path
        config = from_json(data, Config())
        assert differences(data, to_json(config)) == [], path


def test_differences_name_the_field():
    old = to_json(PRESETS["smoke"])
    new = json.loads(json.dumps(old))
    assert differences(old, new) == []
    new["planner"]["horizon"], new["seeds"], new["debug"] = 5, [1], True
    new["num_trials"] = 99  # how long it goes on is not which run it is
    assert differences(old, new) == [
        "planner.horizon: 3 (there) vs 5 (now)",
        "seeds: [0] (there) vs [1] (now)",
    ]


def test_what_a_run_is_does_not_depend_on_where_it_is_or_how_it_is_computed():
    may_change = {entry.name for entry in entries(Config)}
    may_change -= {entry.name for entry in entries(Run)}
    assert may_change == {
        "out", "name", "track", "video", "source", "at_trial", "chunk_length",
        "allow_cpu", "debug", "coordinator_address", "num_processes", "process_id",
    }  # fmt: skip
    config = PRESETS["smoke"]
    elsewhere = dataclasses.replace(config, name="x", chunk_length=1, allow_cpu=True)
    assert part(config, Run) == part(elsewhere, Run)


def test_what_an_older_version_did_not_write_was_the_default():
    default = to_json(PRESETS["paper"])
    old = json.loads(json.dumps(default))
    del old["refit"]["bootstrap"], old["pessimism"], old["tuning"]
    del old["distill"]["critic"]
    assert differences(old, default) == []
    new = {**default, "pessimism": 3.0}
    new["distill"] = to_json(PRESETS["paper"].distill)
    new["distill"]["critic"]["num_updates"] = 9
    new["refit"] = {**default["refit"], "bootstrap": False}
    new["tuning"] = {**default["tuning"], "num_epochs": 9}
    assert differences(old, new) == [
        "pessimism: 0.0 (there) vs 3.0 (now)",
        "refit.bootstrap: True (there) vs False (now)",
    ]


def test_what_a_phase_does_not_read_is_no_difference():
    """Older versions took it and wrote it down, or had another default."""
    old, new = to_json(PRESETS["smoke"]), to_json(PRESETS["smoke"])
    old["phase"] = new["phase"] = "zero-shot"
    old["planner"]["horizon"], old["distill"]["num_rounds"] = 9, 9
    assert differences(old, new) == []
    old["phase"] = new["phase"] = "distill"
    assert differences(old, new) == ["distill.num_rounds: 9 (there) vs 2 (now)"]
    old["distill"]["num_rounds"], old["critic"]["num_updates"] = 2, 9
    assert differences(old, new) == []
    del old["distill"]["critic"]  # then it was read
    assert differences(old, new) == ["critic.num_updates: 9 (there) vs 0 (now)"]


def test_a_run_of_a_newer_version_is_not_continued():
    """What this version does not know it cannot do as it was done."""
    config = to_json(Config())
    with pytest.raises(CheckpointError, match="unknown entry 'colour'"):
        differences({**config, "colour": 1}, config)

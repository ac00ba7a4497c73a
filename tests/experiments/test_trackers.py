"""Trackers: what they are sent, that a run goes on in one, that none stops a run."""

import io
import json
import shutil
import sqlite3
import struct

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from experiments.entries import differences, to_json
from experiments.errors import InterruptedRun
from experiments.presets import PRESETS
from experiments.run import main
from experiments.storage import folder, rundir, trackers


@pytest.fixture
def opened(tmp_path, monkeypatch):
    """Opens a run that is tracked; all that trackers keep is in the test's folder."""
    for name in ("HOME", "TRACKIO_DIR", "WANDB_CONFIG_DIR", "WANDB_CACHE_DIR"):
        monkeypatch.setenv(name, str(tmp_path / name.lower()))
    monkeypatch.delenv("WANDB_MODE", raising=False)

    def open_run(kind, **changes):
        config = to_json(PRESETS["smoke"]) | {"track": kind} | changes
        return folder.open_run(tmp_path / "run", config, differences, 0)

    return open_run


@pytest.fixture
def mp4(tmp_path):
    path = tmp_path / "a.mp4"
    writer = imageio_ffmpeg.write_frames(str(path), (64, 32), fps=20)
    writer.send(None)
    for i in range(8):
        writer.send(np.full((32, 64, 3), 20 * i, np.uint8))
    writer.close()
    return path


def row(trial, **changes):
    own = {"phase": "explore", "arm": "epistemic", "seed": 0, "trial": trial}
    return own | {"value": float(trial), "fit": {"nll": -1.5}} | changes


def record(run, trial):
    state = {"x": np.ones(1, np.float32)}
    run.record(trial, [row(trial)], state, state)


def events(run):
    """Reads what TensorBoard would: (step, tag, value)."""
    pb = pytest.importorskip("tensorboardX.proto.event_pb2")
    for path in (run / "tensorboard").iterdir():
        data = path.read_bytes()
        while data:
            (size,) = struct.unpack("<Q", data[:8])
            event = pb.Event.FromString(data[12 : 12 + size])
            data = data[16 + size :]
            for value in event.summary.value:
                yield event.step, value.tag, value
            if event.session_log.status:
                yield event.step, "cut", None


def test_numbers_have_the_names_of_what_they_are():
    rows = [
        row(3, seed=seed, returns={"run": 2.0 * seed, "hop": None}, turns=None)
        for seed in (4, 5)
    ]
    assert trackers.scalars(rows[:1]) == {
        "explore/value": 3.0, "explore/fit/nll": -1.5, "explore/returns/run": 8.0,
    }  # fmt: skip
    assert trackers.scalars(rows)["explore/returns/run/seed 5"] == 10.0
    zero = [
        row(
            i,
            phase="zero-shot",
            task="run",
            returns={"run": i, "hop": 9},
            **{"return": i},
        )
        for i in (1, 2)
    ]
    found = trackers.scalars(zero)
    assert found["zero-shot/return/run"] == 1.5  # trials of one seed
    three = [
        row(1, phase="distill", task="run", planner=who, **{"return": i})
        for i, who in enumerate(("plan", "policy", "both"))
    ]
    assert trackers.scalars(three)["distill/return/run/policy"] == 1.0
    assert not any("returns" in name for name in found)


def test_a_run_goes_on_in_tensorboard(opened, tmp_path, mp4, capsys):
    with opened("tensorboard") as run:
        record(run, 1)
        record(run, 2)
    shutil.rmtree(tmp_path / "run" / rundir.CHECKPOINTS / "2")
    with opened("tensorboard") as run:
        record(run, 2)
        run.track_video(2, "forward", mp4)
    found = list(events(tmp_path / "run"))
    steps = [step for step, tag, _ in found if tag == "explore/value"]
    assert sorted(steps) == [1, 2, 2] and (2, "cut", None) in found
    text = next(value for _, tag, value in found if tag.startswith("config"))
    assert '"preset": "smoke"' in text.tensor.string_val[0].decode()
    image = next(value.image for _, tag, value in found if tag == "video/forward")
    gif = Image.open(io.BytesIO(image.encoded_image_string))
    assert (gif.format, gif.n_frames, gif.size) == ("GIF", 2, (32, 16))
    assert "tracked: tensorboard --logdir " in capsys.readouterr().err


def twice(opened, kind, mp4):
    """Shows two trials of a run, opened for each, and a video; returns its name."""
    for trial in (1, 2):
        with opened(kind) as run:
            record(run, trial)
            run.track_video(trial, "forward", mp4)
    return rundir.read_json(run.path / rundir.IDENTITY)["id"]


def test_a_run_goes_on_in_wandb(opened, tmp_path, mp4, capsys):
    pytest.importorskip("wandb")
    known = twice(opened, "wandb", mp4)
    logs = sorted((tmp_path / "run" / "wandb").glob("offline-run-*/*.wandb"))
    assert [log.name for log in logs] == [f"run-{known}.wandb"] * 2
    for log in logs:
        assert b"explore/fit/nll" in log.read_bytes()
        assert len(list(log.parent.rglob("*.mp4"))) == 1
    assert capsys.readouterr().err.count("tracked: wandb sync ") == 2


def test_a_run_goes_on_in_trackio(opened, tmp_path, mp4):
    pytest.importorskip("trackio")
    known = twice(opened, "trackio", mp4)
    with sqlite3.connect(tmp_path / "trackio_dir" / "jaxpets.db") as base:
        rows = base.execute("select run_name, step, metrics from metrics").fetchall()
        configs = base.execute("select config from configs").fetchall()
    assert {name for name, _, _ in rows} == {f"run {known}"}
    logged = [(step, json.loads(text)) for _, step, text in rows]
    values = {step: x["explore/value"] for step, x in logged if "explore/value" in x}
    assert values == {1: 1.0, 2: 2.0}
    assert json.loads(configs[0][0])["num_trials"] == PRESETS["smoke"].num_trials


@pytest.mark.parametrize("kind", ["tensorboard", "wandb", "trackio"])
def test_a_tracker_that_fails_is_given_up(kind, opened, monkeypatch, capsys):
    def fails(about):
        raise ConnectionError("no such host\nat all")

    monkeypatch.setitem(trackers._OPEN, kind, fails)
    with opened(kind) as run:
        record(run, 1)
        record(run, 2)
        assert run.steps() == [1, 2]
    said = capsys.readouterr().err
    assert said == (
        f"warning: --track {kind}: no such host; the run goes on without it.\n"
    )


def test_a_tracker_that_does_not_end_is_left(opened, monkeypatch, capsys):
    forever = trackers.threading.Event()
    silent = trackers.Tracker(lambda *_: None, lambda *_: None, forever.wait, "nowhere")
    monkeypatch.setitem(trackers._OPEN, "wandb", lambda about: silent)
    monkeypatch.setattr(trackers, "_CLOSE_SECONDS", 0.1)
    with opened("wandb") as run:
        record(run, 1)
    forever.set()
    assert "--track wandb: it did not end in 0.1 s; the" in capsys.readouterr().err


def test_a_signal_is_no_failure_of_a_tracker(opened, monkeypatch):
    def stopped(about):
        raise InterruptedRun("SIGTERM")

    monkeypatch.setitem(trackers._OPEN, "wandb", stopped)
    with pytest.raises(InterruptedRun), opened("wandb") as run:
        record(run, 1)


def test_a_link_is_not_followed(opened, tmp_path, capsys):
    outside = tmp_path / "outside"
    outside.mkdir()
    with opened("tensorboard") as run:
        (run.path / "tensorboard").symlink_to(outside)
        record(run, 1)
    assert not list(outside.iterdir())
    assert "tensorboard is a link" in capsys.readouterr().err


def test_one_that_is_not_installed_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(trackers._MODULES, "wandb", "none_such")
    flags = ["explore", "--preset", "smoke", "--track", "wandb"]
    assert main([*flags, "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert 'pip install "jaxpets[wandb]" brings' in said and said.count("\n") == 1
    assert not (tmp_path / "out").exists()

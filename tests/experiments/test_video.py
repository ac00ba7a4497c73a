"""The video of a trial: rendered for real where OpenGL works."""

import subprocess

import numpy as np
import pytest
import runs

from experiments.errors import RunError, UsageError
from experiments.tools import video
from jaxpets.envs import half_cheetah

NUM_STEPS = 24


@pytest.fixture
def npz(tmp_path):
    """Two seeds, two tasks and two trials; the robot drives forward, nose down."""
    obs = np.zeros((2, 2, 2, NUM_STEPS, half_cheetah.OBS_SIZE), np.float32)
    obs[..., half_cheetah.FORWARD_VELOCITY] = 3.0
    obs[..., half_cheetah.PITCH] = np.linspace(0.0, 3.0, NUM_STEPS)
    obs[1, 1, 1, :, half_cheetah.HEIGHT] = 0.25
    path = tmp_path / "trajectories.npz"
    np.savez(
        path,
        obs=obs,
        seeds=np.array([4, 7]),
        tasks=np.array(["forward", "back-flip"]),
        returns=np.zeros((2, 2, 2)),
    )
    return path


def command(*args):
    """Returns the exit code of the command, and what it said on stderr."""
    process = runs.start("-m", "experiments.tools.video", *args)
    errors = process.communicate(timeout=100)[1]
    return process.returncode, errors


def require_gl(error):
    """Skips where there is no OpenGL, and fails on every other error."""
    if "cannot render a video" in str(error):
        pytest.skip(f"no OpenGL: {error}")
    raise error


def read_video(path):
    """Returns what ffmpeg says about a video, and its frames."""
    import imageio_ffmpeg

    ffmpeg = imageio_ffmpeg.get_ffmpeg_exe()
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run([ffmpeg, "-i", path, *raw], capture_output=True, check=True)
    frames = np.frombuffer(done.stdout, np.uint8).reshape(-1, 360, 640, 3)
    return done.stderr.decode(), frames


def test_render_writes_every_step_in_real_time(npz, tmp_path):
    from PIL import Image

    target = tmp_path / "new" / "trial.mp4"
    try:
        video.render(npz, target, task="back-flip", seed=7, trial=2, gif=True)
    except RunError as error:
        require_gl(error)
    about, frames = read_video(target)
    assert "h264" in about
    assert "640x360" in about
    assert "20 fps" in about
    assert len(frames) == NUM_STEPS
    # The camera follows, the robot turns: frames differ, and none is empty.
    first, last = (frames[i].astype(float) for i in (0, -1))
    assert min(first.std(), last.std()) > 20.0
    assert np.abs(first - last).mean() > 3.0
    gif = Image.open(target.with_suffix(".gif"))
    assert gif.n_frames == NUM_STEPS // 2
    assert gif.info["duration"] == 100
    assert target.with_suffix(".gif").stat().st_size < 500_000
    assert {path.name for path in target.parent.iterdir()} == {"trial.mp4", "trial.gif"}


def test_no_gl_is_one_clear_line(npz, tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "crayons")
    target = tmp_path / "trial.mp4"
    with pytest.raises(RunError) as info:
        video.render(npz, target, task="forward", seed=4, trial=1)
    text = str(info.value)
    assert "cannot render a video" in text
    assert "crayons" in text
    assert "libegl1 libopengl0 libgl1-mesa-dri" in text
    assert "\n" not in text
    assert not target.exists()


def test_render_passes_on_what_is_wrong_with_the_file(npz, tmp_path):
    with pytest.raises(RunError, match=r"--task swim: .* holds forward, back-flip"):
        video.render(npz, tmp_path / "a.mp4", task="swim", seed=4, trial=1)


def test_load_trial_takes_the_named_one(npz):
    chosen = video.load_trial(npz, task="back-flip", seed=7, trial=2)
    assert chosen.shape == (NUM_STEPS, half_cheetah.OBS_SIZE)
    assert (chosen[:, half_cheetah.HEIGHT] == 0.25).all()
    other = video.load_trial(npz, task="back-flip", seed=7, trial=1)
    assert (other[:, half_cheetah.HEIGHT] == 0.0).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": 5}, r"--seed 5: .* holds \[4, 7\]"),
        ({"task": "swim"}, "--task swim: .* holds forward, back-flip"),
        ({"trial": 0}, "--trial 0: .* holds 1 to 2"),
        ({"trial": 3}, "--trial 3: .* holds 1 to 2"),
    ],
)
def test_load_trial_says_what_there_is(npz, changes, message):
    with pytest.raises(UsageError, match=message):
        video.load_trial(npz, **{"task": "forward", "seed": 4, "trial": 1, **changes})


def test_load_trial_refuses_what_is_no_trajectory(npz, tmp_path):
    which = {"task": "forward", "seed": 4, "trial": 1}
    damaged = tmp_path / "damaged.npz"
    damaged.write_bytes(npz.read_bytes()[:200])
    for path in (damaged, tmp_path / "none.npz"):
        with pytest.raises(UsageError, match="holds no trajectories"):
            video.load_trial(path, **which)
    arrays = dict(np.load(npz))
    np.savez(tmp_path / "flat.npz", **{**arrays, "obs": arrays["obs"][0]})
    with pytest.raises(UsageError, match=r"must be \[seeds, tasks, trials, steps, D\]"):
        video.load_trial(tmp_path / "flat.npz", **which)
    arrays["obs"][0, 0, 0, 5:] = np.nan
    np.savez(tmp_path / "nan.npz", **arrays)
    with pytest.raises(RunError, match="not finite from step 5"):
        video.load_trial(tmp_path / "nan.npz", **which)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--width", "31"], "--width 31: from 64 to 4096"),
        (["--height", "361"], "--height 361: must be even"),
        (["--fps", "0"], "--fps 0: from 1 to 120"),
        (["--seed", "9"], "--seed 9"),
    ],
)
def test_bad_flags_exit_with_2_and_one_line(npz, tmp_path, flags, message):
    target = tmp_path / "a.mp4"
    code, errors = command(npz, target, "--task", "forward", "--seed", "4", *flags)
    assert code == 2
    assert message in errors
    assert errors.count("\n") == 1
    assert not target.exists()


@pytest.mark.parametrize(
    ("env", "message"),
    [
        ([], "--env is missing; {} has observations of 21 entries, and pets/half_chee"),
        (
            ["--env", "pets/half_cheetah"],
            "--env pets/half_cheetah is not valid; {} has",
        ),
    ],
)
def test_a_trial_of_another_robot_is_not_drawn(npz, tmp_path, env, message):
    arrays = dict(np.load(npz))
    arrays["obs"] = np.pad(arrays["obs"], [(0, 0)] * 4 + [(0, 3)])
    np.savez(npz, **arrays)
    which = ("--task", "forward", "--seed", "4", *env)
    code, errors = command(npz, tmp_path / "a.mp4", *which)
    assert code == 2
    assert errors.startswith(f"error: {message.format(npz)}")
    assert "has 18. Name the robot that performed." in errors
    assert errors.count("\n") == 1
    assert not (tmp_path / "a.mp4").exists()


def test_the_target_must_be_an_mp4(npz, tmp_path):
    code, errors = command(npz, tmp_path / "a.avi", "--task", "forward", "--seed", "4")
    assert code == 2
    assert "must end in .mp4" in errors

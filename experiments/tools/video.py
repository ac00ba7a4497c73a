"""Renders a recorded trial of a robot, in a process of its own.

`python -m experiments.tools.video TRAJECTORIES.npz OUT.mp4 --env pets/half_cheetah
--task forward --seed 0 --trial 1`

OpenGL can crash, and its backend is chosen once per process; an experiment of hours
must depend on neither. So `render` starts this module as a child.
"""

import argparse
import logging
import math
import os
import sys
import warnings
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..errors import RunError, UsageError
from ..storage import disk
from . import opengl
from .renderer import NO_GL, Draw, Look, open_renderer

if TYPE_CHECKING:  # it brings mujoco, which may find no OpenGL
    from jaxpets.envs import Robot

_SIZE_RANGE = range(64, 4097)
_FPS_RANGE = range(1, 121)

# A GIF is for a page: a small cut with few colours, and every second frame.
_GIF_WIDTH, _GIF_COLORS, _GIF_SKIP = 280, 48, 2


def render(
    npz: Path, target: Path, *, task: str, seed: int, trial: int, gif: bool = False,
    env: str | None = None,
) -> None:  # fmt: skip
    """Renders a trial of a robot (see `load_trial`), in a child process.

    It is an mp4 and, if it is asked for, a GIF.

    MUJOCO_GL of the user is obeyed; otherwise EGL is tried, then OSMesa.

    Raises:
      RunError: if no OpenGL works here, or the child fails; one line says why.
    """
    words = [str(npz), str(target)]
    words += [f"--env={env}"] * (env is not None)
    words += [f"--task={task}", f"--seed={seed}", f"--trial={trial}"]
    words += ["--gif"] * gif
    opengl.in_child("video", words)


def load_trial(npz: Path, *, task: str, seed: int, trial: int) -> np.ndarray:
    """Reads one trial from recorded trajectories.

    Args:
      npz: holds obs `[S, K, R, T, D]` float32, each after its step, seeds `[S]`,
        tasks `[K]` and returns `[S, K, R]`.
      task: an entry of tasks.
      seed: an entry of seeds.
      trial: from 1 to R.

    Returns:
      obs `[T, D]`.

    Raises:
      UsageError: if the file is not such a file or does not hold the trial.
      RunError: if the trial is not finite.
    """
    try:
        with np.load(npz, allow_pickle=False) as file:
            obs, seeds, tasks = file["obs"], file["seeds"], file["tasks"]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise UsageError(f"{npz} holds no trajectories ({error})") from error
    if obs.ndim != 5 or obs.shape[:2] != (len(seeds), len(tasks)):
        raise UsageError(
            f"{npz}: obs must be [seeds, tasks, trials, steps, D], got {obs.shape}"
        )
    seed_names, task_names = seeds.tolist(), tasks.tolist()
    if task not in task_names:
        raise UsageError(f"--task {task}: {npz} holds {', '.join(task_names)}")
    if seed not in seed_names:
        raise UsageError(f"--seed {seed}: {npz} holds {seed_names}")
    if not 1 <= trial <= obs.shape[2]:
        raise UsageError(f"--trial {trial}: {npz} holds 1 to {obs.shape[2]}")
    chosen = obs[seed_names.index(seed), task_names.index(task), trial - 1]
    finite = np.isfinite(chosen).all(axis=-1)
    if not finite.all():
        raise RunError(f"{npz}: the trial is not finite from step {finite.argmin()} on")
    return chosen


def write_mp4(target: Path, pictures: Iterator[np.ndarray], look: Look) -> None:
    """Writes pictures as H.264."""
    import imageio_ffmpeg

    # Of a video without a picture, whose reason is said elsewhere.
    logging.getLogger("imageio_ffmpeg").setLevel(logging.ERROR)
    size = (look.width, look.height)
    # yuv420p wants even sizes, no more.
    writer = imageio_ffmpeg.write_frames(
        str(target), size, fps=look.fps, macro_block_size=2, ffmpeg_log_level="error"
    )
    with warnings.catch_warnings():
        # JAX warns of any fork; this one becomes ffmpeg at once.
        warnings.filterwarnings("ignore", r"os\.fork\(\) was called", RuntimeWarning)
        writer.send(None)
    try:
        for picture in pictures:
            writer.send(np.ascontiguousarray(picture))
    finally:
        writer.close()


def write_gif(target: Path, cut: list[np.ndarray], *, fps: float) -> None:
    """Writes pictures as a small GIF, with one palette for all its frames."""
    from PIL import Image

    height = round(_GIF_WIDTH * cut[0].shape[0] / cut[0].shape[1])
    small = [Image.fromarray(p).resize((_GIF_WIDTH, height)) for p in cut]
    # Half of the colours by frequency, for the sky; half by coverage, for the robot.
    every = Image.fromarray(np.concatenate([np.asarray(p) for p in small[::5]]))
    colors: list[int] = []
    for method in (Image.Quantize.MEDIANCUT, Image.Quantize.MAXCOVERAGE):
        half = every.quantize(_GIF_COLORS // 2, method)
        colors += (half.getpalette() or [])[: 3 * _GIF_COLORS // 2]
    palette = Image.new("P", (1, 1))
    palette.putpalette(colors)
    # No dither: its noise changes every frame, which is what costs bytes.
    indexed = [s.quantize(palette=palette, dither=Image.Dither.NONE) for s in small]
    indexed[0].save(
        target,
        save_all=True,
        append_images=indexed[1:],
        duration=round(1000 / fps),
        loop=0,
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f"python -m {__package__}.video",
        description="Renders a recorded trial of a robot to mp4.",
    )
    parser.add_argument("npz", type=Path, help="trajectories.npz of a run")
    parser.add_argument("target", type=Path, help="the .mp4 to write")
    parser.add_argument("--env", help="the robot; by default pets/half_cheetah")
    parser.add_argument("--task", required=True, help="for example forward")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--trial", type=int, default=1, help="counted from 1")
    parser.add_argument("--fps", type=int, help="by default real time")
    parser.add_argument("--width", type=int, default=Look().width)
    parser.add_argument("--height", type=int, default=Look().height)
    parser.add_argument("--gif", action="store_true", help="also write a short .gif")
    parser.add_argument("--gif-start", type=float, default=10.0, help="in s")
    parser.add_argument("--gif-seconds", type=float, default=4.0)
    return parser


def _check(args: argparse.Namespace) -> None:
    if args.target.suffix != ".mp4":
        raise UsageError(f"the target must end in .mp4, got {args.target}")
    ranges = {"width": _SIZE_RANGE, "height": _SIZE_RANGE, "fps": _FPS_RANGE}
    for name, valid in ranges.items():
        value = getattr(args, name)
        if value is not None and value not in valid:
            raise UsageError(
                f"--{name} {value}: from {valid.start} to {valid.stop - 1}"
            )
    if args.width % 2 or args.height % 2:
        raise UsageError(f"--width {args.width} --height {args.height}: must be even")
    for name, low in [("gif_start", 0.0), ("gif_seconds", 0.1)]:
        if not low <= getattr(args, name) < math.inf:
            flag = f"--{name.replace('_', '-')}"
            raise UsageError(f"{flag} {getattr(args, name)}: at least {low}")


def _render_here(args: argparse.Namespace) -> None:
    _check(args)
    obs = load_trial(args.npz, task=args.task, seed=args.seed, trial=args.trial)
    robot = _robot(args.env)
    _check_size(args.npz, obs, robot, args.env)
    if args.fps is None:
        args.fps = min(round(1 / robot.step_time), _FPS_RANGE.stop - 1)
    look = Look(args.width, args.height, args.fps)
    wanted = _gif_steps(args, len(obs))
    cut: list[np.ndarray] = []

    def pictures() -> Iterator[np.ndarray]:
        draw, positions = _opened(robot, obs, look)
        for step, qpos in enumerate(positions):
            picture = draw(qpos)
            if step in wanted:
                cut.append(picture)
            yield picture

    args.target.parent.mkdir(parents=True, exist_ok=True)
    with disk.replaced(args.target) as draft:
        write_mp4(draft, pictures(), look)
    if cut:
        with disk.replaced(args.target.with_suffix(".gif")) as draft:
            write_gif(draft, cut, fps=args.fps / _GIF_SKIP)


def _robot(env: str | None) -> "Robot":
    """Returns the robot that is drawn."""
    try:
        from .. import robots
        from ..storage.rundir import HALF_CHEETAH

        robot = robots.named(env or HALF_CHEETAH, "mujoco")
    except RunError:
        raise
    except Exception as error:  # importing MuJoCo with an OpenGL that is none
        raise _no_gl(error) from error
    if robot.model is None or robot.qpos_fn is None:
        raise UsageError(f"--env {env} has no model that can be drawn.")
    return robot


def _check_size(npz: Path, obs: np.ndarray, robot: "Robot", env: str | None) -> None:
    """Refuses trajectories of another robot, of which entries would be missing."""
    from .. import robots

    found, (wanted, _) = obs.shape[-1], robots.sizes(robot)
    if found != wanted:
        said = f"--env {env} is not valid" if env else "--env is missing"
        name = env or f"{robot.name}, which is drawn without it,"
        raise UsageError(
            f"{said}; {npz} has observations of {found} entries, and {name} has "
            f"{wanted}. Name the robot that performed."
        )


def _opened(robot: "Robot", obs: np.ndarray, look: Look) -> tuple[Draw, np.ndarray]:
    """Returns what draws a robot and where it was, qpos `[T, Q]`."""
    import jax
    import jax.numpy as jnp

    assert robot.qpos_fn
    try:
        draw = open_renderer(robot.model, look, robot.camera)
    except Exception as error:  # ImportError, RuntimeError, AttributeError, ...
        raise _no_gl(error) from error
    positions = np.asarray(jax.jit(robot.qpos_fn)(jnp.asarray(obs)))
    if not np.isfinite(positions).all():
        raise UsageError(f"{robot.name} does not observe positions to draw it by.")
    return draw, positions


def _no_gl(error: Exception) -> SystemExit:
    reason = str(error).splitlines() or [type(error).__name__]
    print("error:", reason[0], file=sys.stderr)
    return SystemExit(NO_GL)


def _gif_steps(args: argparse.Namespace, num_steps: int) -> range:
    """Returns the steps that the GIF shows; a start too late is moved forward."""
    if not args.gif:
        return range(0)
    length = min(max(round(args.gif_seconds * args.fps), 1), num_steps)
    first = min(round(args.gif_start * args.fps), num_steps - length)
    return range(first, first + length, _GIF_SKIP)


def main() -> None:
    """Runs the command line; errors are one line and an exit code."""
    args = _parser().parse_args()
    # Read once, when JAX and MuJoCo are imported. Rendering needs no GPU of JAX's.
    os.environ["JAX_PLATFORMS"] = "cpu"
    os.environ.setdefault("MUJOCO_GL", opengl.BACKENDS[0])
    try:
        _render_here(args)
    except RunError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from error
    except OSError as error:
        print(f"error: cannot write {args.target} ({error})", file=sys.stderr)
        raise SystemExit(5) from error


if __name__ == "__main__":
    main()

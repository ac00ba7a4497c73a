"""A run in a tracker beside its folder: TensorBoard, Weights & Biases or Trackio.

A tracker shows a run, and has no part in it: one that fails is given up, with a line.
Each is three functions of a few lines; `Tracked` does the rest. It is opened by what is
recorded first, and has the id of the run's folder, by which a run goes on where it was.
"""

import contextlib
import importlib
import importlib.util
import io
import json
import os
import struct
import subprocess
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import UsageError
from ..parallel import distributed
from . import disk, identity, rundir

# What is imported for each, which is also the extra that brings it.
_MODULES = {"tensorboard": "tensorboardX", "wandb": "wandb", "trackio": "trackio"}
_PROJECT = "jaxpets"
_INIT_SECONDS, _CLOSE_SECONDS = 10, 20  # that a network may take
_NUMBERS = ("value", "turns", "return", "bad_plans", "lost_steps")
_GROUPS = ("returns", "fit", "seconds")


class About(NamedTuple):
    """What a tracker is told of a run when it is opened."""

    folder: Path
    config: Mapping[str, Any]  # in JSON
    name: str
    id: str  # of the folder
    step: int  # the first to come; later ones are of a run that was cut back


class Tracker(NamedTuple):
    """A run in one tracker, as its functions.

    scalars: `(step, numbers by name)`.
    video: `(step, name, mp4)`.
    close: waits for what is on its way.
    where: what a user types to see it.
    """

    scalars: Callable[[int, Mapping[str, float]], None]
    video: Callable[[int, str, Path], None]
    close: Callable[[], None]
    where: str


def check(kind: str | None) -> None:
    """Refuses a tracker that is not installed.

    Raises:
      UsageError: with what to install.
    """
    if kind is not None and importlib.util.find_spec(_MODULES[kind]) is None:
        need = f'pip install "jaxpets[{kind}]"'
        raise UsageError(f"--track {kind} needs {_MODULES[kind]}, which {need} brings.")


class Tracked:
    """A run's tracker, if it has one, from the first thing to show to the end."""

    def __init__(self, folder: Path, config: Mapping[str, Any]) -> None:
        self._kind: str | None = config.get("track")
        self._folder, self._config = folder, config
        self._tracker: Tracker | None = None

    def rows(self, step: int, rows: Sequence[Mapping[str, Any]]) -> None:
        """Shows rows of the log."""
        self._show(step, lambda tracker: tracker.scalars(step, scalars(rows)))

    def video(self, step: int, name: str, path: Path) -> None:
        """Shows a video of a task."""
        self._show(step, lambda tracker: tracker.video(step, f"video/{name}", path))

    def close(self) -> None:
        """Ends it; a network that does not answer is not waited for."""
        if self._tracker is None:
            return
        closing = threading.Thread(target=self._quietly, daemon=True)
        closing.start()
        closing.join(_CLOSE_SECONDS)
        if closing.is_alive():
            self._give_up(f"it did not end in {_CLOSE_SECONDS} s")

    def _quietly(self) -> None:
        assert self._tracker is not None
        with contextlib.suppress(Exception):
            self._tracker.close()

    def _show(self, step: int, send: Callable[[Tracker], None]) -> None:
        if self._kind is None:
            return
        try:
            if self._tracker is None:
                self._tracker = _OPEN[self._kind](self._about(step))
                distributed.say(f"tracked: {self._tracker.where}")
            send(self._tracker)
        except Exception as error:
            self._give_up(_line(error))

    def _about(self, step: int) -> About:
        folder, name = self._folder, self._folder.name
        if self._config["phase"] != "explore":  # it is inside that of exploration
            name = f"{folder.parent.name}/{name}"
        known = identity.read_id(folder) or name
        return About(folder, self._config, name, known, step)

    def _give_up(self, reason: str) -> None:
        kind, self._kind = self._kind, None
        distributed.say(
            f"warning: --track {kind}: {reason}; the run goes on without it."
        )


def _line(error: Exception) -> str:
    line, *_ = [*str(error).splitlines(), type(error).__name__]
    return line


def scalars(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Returns the numbers of rows of one phase by name, means where rows share one.

    A name is as `explore/fit/nll`, and says task and seed where there are several, and
    who acts in distill.
    """
    several = len({row["seed"] for row in rows}) > 1
    found: dict[str, list[float]] = {}
    for row in map(rundir.plain, rows):
        task = row.get("task")
        tail = [task] * bool(task) + [f"seed {row['seed']}"] * several
        tail += [row["planner"]] if row["phase"] == "distill" else []
        numbers = {name: row.get(name) for name in _NUMBERS}
        for group in _GROUPS:
            if group != "returns" or not task:  # a task's own return is enough
                own = row.get(group) or {}
                numbers |= {f"{group}/{name}": value for name, value in own.items()}
        for name, value in numbers.items():
            if value is not None:
                tag = "/".join([row["phase"], name, *tail])
                found.setdefault(tag, []).append(float(value))
    return {tag: sum(values) / len(values) for tag, values in found.items()}


def _tensorboard(about: About) -> Tracker:
    """Writes events into the run's folder; a video is a GIF among the images."""
    tb: Any = importlib.import_module("tensorboardX")
    proto: Any = importlib.import_module("tensorboardX.proto.summary_pb2")
    folder = about.folder / "tensorboard"
    disk.check_own(folder, folder=True)
    writer = tb.SummaryWriter(
        str(folder), purge_step=about.step, filename_suffix=f".{about.step}"
    )
    text = json.dumps(about.config, indent=2)
    writer.add_text("config", f"```\n{text}\n```", 0)

    def scalars(step: int, numbers: Mapping[str, float]) -> None:
        for name, value in numbers.items():
            writer.add_scalar(name, value, step)
        writer.flush()

    def video(step: int, name: str, path: Path) -> None:
        gif = _gif(path)
        width, height = struct.unpack("<HH", gif[6:10])
        image = proto.Summary.Image(
            height=height, width=width, colorspace=3, encoded_image_string=gif
        )
        summary = proto.Summary(value=[proto.Summary.Value(tag=name, image=image)])
        writer.file_writer.add_summary(summary, step)

    return Tracker(scalars, video, writer.close, f"tensorboard --logdir {folder}")


def _wandb(about: About) -> Tracker:
    """Writes into the run's folder, to be synced; WANDB_MODE=online sends at once."""
    wandb: Any = importlib.import_module("wandb")
    disk.check_own(about.folder / "wandb", folder=True)

    def begun(mode: str) -> Any:
        return wandb.init(
            project=_PROJECT, dir=about.folder, id=about.id, name=about.name,
            config=dict(about.config), mode=mode, resume="allow",
            settings=wandb.Settings(
                console="off", silent=True, init_timeout=_INIT_SECONDS,
                save_code=False, x_disable_stats=True,
            ),
        )  # fmt: skip

    mode = os.environ.get("WANDB_MODE", "offline")
    try:
        run = begun(mode)
    except Exception as error:
        if mode != "online":
            raise
        distributed.say(f"warning: wandb is offline: {_line(error)}")
        wandb.teardown()  # it holds the id
        run = begun("offline")
    run.define_metric("*", step_metric="trial")

    def scalars(step: int, numbers: Mapping[str, float]) -> None:
        run.log({**numbers, "trial": step})

    def video(step: int, name: str, path: Path) -> None:
        run.log({name: wandb.Video(str(path), format="mp4"), "trial": step})

    folder = Path(run.dir).parent
    where = f"wandb sync {folder}" if run.offline else str(run.url)
    return Tracker(scalars, video, run.finish, where)


def _trackio(about: About) -> Tracker:
    """Writes where Trackio keeps all runs of this user, or TRACKIO_DIR."""
    trackio: Any = importlib.import_module("trackio")
    with contextlib.redirect_stdout(io.StringIO()):
        run = trackio.init(
            project=_PROJECT, name=f"{about.name} {about.id}", resume="allow",
            config=dict(about.config), embed=False, auto_log_gpu=False,
            auto_log_cpu=False,
        )  # fmt: skip

    def scalars(step: int, numbers: Mapping[str, float]) -> None:
        run.log(dict(numbers), step)

    def video(step: int, name: str, path: Path) -> None:
        run.log({name: trackio.Video(str(path))}, step)

    def close() -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            run.finish()

    return Tracker(scalars, video, close, f"trackio show --project {_PROJECT}")


_OPEN = {"tensorboard": _tensorboard, "wandb": _wandb, "trackio": _trackio}


def _gif(path: Path) -> bytes:
    """Returns a video at half its size, five pictures a second."""
    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", f"file:{path}"]
    command += ["-vf", "fps=5,scale=iw/2:-1", "-f", "gif", "-"]
    return subprocess.run(command, check=True, capture_output=True).stdout

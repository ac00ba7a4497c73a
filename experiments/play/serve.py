"""Puts a page together and keeps it up."""

import os
import secrets
import socket
import stat
import sys
import threading
import webbrowser
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import viser

from jaxpets.envs import Robot

from .. import build
from ..errors import UsageError
from . import asking, source, wishes
from .core import core
from .gate import Gate
from .live import Live
from .page import Page
from .pilot import Pilot
from .run_part import RunPart
from .server import serving
from .session import Session
from .watch import Replay, Watched
from .wish_part import WishPart
from .wishes import Language

_PORT = 8080


class Options(NamedTuple):
    """What the command line says."""

    source: str
    env: str | None = None
    seed: int | None = None
    watch: Path | None = None
    port: int | None = None
    host: str | None = None
    fps: float = 50.0
    no_open: bool = False


def _say(address: str) -> None:
    print(f"open {address} (Ctrl-C ends it)", flush=True)


def serve(
    options: Options,
    is_over: threading.Event | None = None,
    tell: Callable[[str], None] = _say,
) -> None:
    """Serves a page.

    Args:
      options: of the command line.
      is_over: ends it; None serves for ever.
      tell: gets the address, once it is open.

    Raises:
      RunError: if there is no such model or run, or the address is not to be had.
    """
    is_over = is_over or threading.Event()
    keep_programs()
    with serving() as server:
        gate = _opened(options, server.get_port())
        tell(gate.address)
        try:
            make = _live if options.watch is None else _watching
            session, page = make(server, options)
            if not options.no_open and _has_display():
                webbrowser.open(gate.address)
            _run(session, page, is_over, options.fps)
        finally:
            gate.close()


def _run(
    session: Session, page: Page, is_over: threading.Event, fps: float
) -> None:
    """Runs the world beside the page until it is over, or the world cannot begin."""
    failed: list[Exception] = []

    def run() -> None:
        try:
            session.run(page.steer)
        except Exception as error:
            failed.append(error)
            is_over.set()

    world = threading.Thread(target=run, daemon=True)
    world.start()
    page.run(is_over.wait, fps)
    session.stop()
    world.join()
    if failed:
        raise failed[0]


def _live(server: viser.ViserServer, options: Options) -> tuple[Session, Page]:
    """Returns the page of a robot that plans."""
    found = source.found(options.source, env=options.env, seed=options.seed)
    robot, params = found.robot, found.params
    rollout, search, _ = source.planner_parts(found)
    horizon = found.search.horizon
    program = core(
        robot, rollout, search, horizon=horizon,
        terminal_fn=build.imagined_end(robot.env),
    )  # fmt: skip
    language = wishes.language_of(robot, params)
    asked = asking.at_first(robot, language, wishes.first(robot, params))
    session = Session(Live(robot, program, params), asked)
    session.notice = "It compiles the planner: some seconds, once on this machine."
    page = Page(
        server, robot, options.env or robot.name, session,
        lambda gui, add: WishPart(gui, add, language, horizon),
        partial(Pilot, robot, language), _title(robot, found.title),
    )  # fmt: skip
    return session, page


def _watching(server: viser.ViserServer, options: Options) -> tuple[Session, Page]:
    """Returns the page of a run that explores."""
    assert options.watch is not None
    run = Watched(options.watch, env=options.env, seed=options.seed)
    robot, replay = run.robot, Replay(run)
    nothing = Language({}, {}, (), 0)
    session = Session(replay, asking.NOTHING)
    page = Page(
        server, robot, run.env, session,
        lambda gui, add: RunPart(gui, add, run, replay),
        partial(Pilot, None, nothing), _title(robot, options.watch.name),
    )  # fmt: skip
    return session, page


def _title(robot: Robot, of: str) -> str:
    return f"{robot.name.rpartition('/')[2]}: {of}"


class _Open(NamedTuple):
    """A door that is open, and what leads to it."""

    gate: Gate
    address: str

    def close(self) -> None:
        self.gate.close()


def _opened(options: Options, behind: int) -> _Open:
    """Opens the door, and says where it is.

    Raises:
      UsageError: if the address is not to be had.
    """
    host = options.host or "localhost"
    token = secrets.token_urlsafe(16) if options.host else ""
    port = _PORT if options.port is None else options.port
    try:
        gate = Gate(host, port, behind, token)
    except OSError as error:
        if options.port is not None:
            why = error.strerror or error
            raise UsageError(f"--port {port} is not to be had ({why}).") from error
        gate = Gate(host, 0, behind, token)
    name = socket.gethostname() if host in ("0.0.0.0", "::") else host
    address = f"http://{name}:{gate.port}/" + (f"{token}/" if token else "")
    return _Open(gate, address)


def keep_programs() -> None:
    """Has JAX keep what it compiles for the next time, in a folder of the user's own.

    To load a program is to run it: where others may write, nothing is kept.
    """
    config: Any = jax.config
    if config.jax_compilation_cache_dir:
        return
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(home, "jaxpets", "programs")
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.stat()
    except OSError:
        return
    others = stat.S_IWGRP | stat.S_IWOTH
    if found.st_uid != os.getuid() or found.st_mode & others:
        return
    config.update("jax_compilation_cache_dir", str(folder))
    config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def _has_display() -> bool:
    """Returns whether there is a desktop on which to open a browser."""
    if sys.platform != "linux":
        return True
    return any(os.environ.get(x) for x in ("DISPLAY", "WAYLAND_DISPLAY"))

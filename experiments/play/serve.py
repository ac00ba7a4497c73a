"""Puts a page together and keeps it up."""

import dataclasses
import secrets
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import viser

from .. import build, programs
from ..errors import UsageError
from ..policy import of_file
from . import command, source
from .live import Live
from .page import Page
from .plan_part import PlanPart
from .server import serving
from .session import Session
from .watch import Replay, RunPart, Watched

_PORT = 8080


class Options(NamedTuple):
    """What the command line says."""

    source: str
    env: str | None = None
    seed: int | None = None
    policy: Path | None = None
    horizon: int | None = None
    watch: Path | None = None
    port: int | None = None
    host: str | None = None


def serve(
    options: Options,
    is_over: threading.Event,
    tell: Callable[[str], None],
    *,
    rate: float = 50.0,
) -> None:
    """Serves a page.

    Args:
      options: of the command line.
      is_over: ends it.
      tell: gets the address, once it is open.
      rate: pictures a second.

    Raises:
      RunError: if there is no such model or run, or the address is not to be had.
    """
    programs.keep()
    token = secrets.token_urlsafe(16) if options.host else ""
    listener, address = _opened(options)
    with serving(listener, token) as server:
        make = _live if options.watch is None else _watching
        session, page = make(server, options)
        tell(f"{address}{token}/" if token else address)
        world = threading.Thread(target=session.run, args=(page.steer,), daemon=True)
        world.start()
        page.run(is_over.wait, rate)
        session.stop()
        world.join()


def _live(server: viser.ViserServer, options: Options) -> tuple[Session, Page]:
    """Returns the page of a robot that plans."""
    found = source.found(options.source, env=options.env, seed=options.seed)
    robot, horizon = found.robot, options.horizon or found.search.horizon
    search = dataclasses.replace(found.search, horizon=horizon)
    rollout, _ = build.rollout_of(robot, found.size, search)
    file = options.policy or found.policy
    env, names = options.env or robot.name, robot.tasks.names
    policy = of_file(file, robot, env, names) if file else None
    live = Live(
        robot, rollout, build.optimizer(search, robot.env), found.params,
        horizon=horizon, terminal_fn=build.imagined_end(robot.env), policy=policy,
    )  # fmt: skip
    commands = command.Commands(robot, found.params)
    session = Session(live, commands.first)
    session.notice = "It compiles the planner: some seconds, once on this machine."
    page = Page(
        server, robot, env, session, found.title, commands,
        lambda panel: PlanPart(panel, commands, horizon, has_policy=policy is not None),
    )  # fmt: skip
    return session, page


def _watching(server: viser.ViserServer, options: Options) -> tuple[Session, Page]:
    """Returns the page of a run that explores."""
    assert options.watch is not None
    if options.policy is not None:
        raise UsageError("--policy is of a robot that plans; --watch shows a run.")
    run = Watched(options.watch, env=options.env, seed=options.seed)
    replay = Replay(run)
    session = Session(replay, command.NOTHING)
    page = Page(
        server, run.robot, run.env, session, options.watch.name, None,
        lambda panel: RunPart(panel, run, replay),
    )  # fmt: skip
    return session, page


def _opened(options: Options) -> tuple[socket.socket, str]:
    """Returns what listens, and its address.

    Raises:
      UsageError: if the address is not to be had.
    """
    host = options.host or "127.0.0.1"
    port = _PORT if options.port is None else options.port
    try:
        listener = _listener(host, port)
    except (OSError, OverflowError, UnicodeError) as error:
        if options.host or options.port is not None:
            said = (
                f"--host {host} with port {port}" if options.host else f"--port {port}"
            )
            why = getattr(error, "strerror", None) or error
            raise UsageError(f"{said} is not to be had ({why}).") from error
        listener = _listener(host, 0)
    name = options.host or "localhost"
    name = socket.gethostname() if name in ("0.0.0.0", "::") else name
    name = f"[{name}]" if ":" in name else name
    return listener, f"http://{name}:{listener.getsockname()[1]}/"


def _listener(host: str, port: int) -> socket.socket:
    family, *_, address = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0]
    return socket.create_server((address[0], port), family=family)

"""`python -m experiments.play`: opens a page on which a robot does what it is asked."""

import argparse
import os
import threading
import traceback
from collections.abc import Sequence
from pathlib import Path

from .. import calling, robots, signals
from ..errors import ExitCode, InterruptedRun, RunError, UsageError

_FROM = "pretrained/best"
_LONGEST = 1000  # horizon
_EPILOG = """
Ctrl-C ends it. Without --host only this machine can open the page. With it others can,
if they have the token that is then in the address. Whoever sees the page may steer."""


def main(argv: Sequence[str] | None = None) -> int:
    """Serves a page until a signal comes, and returns the exit code."""
    args = _parser().parse_args(argv)
    failed: list[BaseException] = []

    def work() -> None:
        try:
            _serve(args)
        except BaseException as error:  # for the main thread
            failed.append(error)

    try:
        # In a thread, so that a signal is heard at once, whatever is computed.
        with signals.stoppable():
            worker = threading.Thread(target=work, daemon=True)
            worker.start()
            while worker.is_alive():
                worker.join(0.5)
        if failed:
            raise failed[0]
    except InterruptedRun as error:
        signals.say(f"stopped: {error}.")
        return ExitCode(error)
    except RunError as error:
        if args.debug:
            traceback.print_exc()
        signals.say(f"error: {error}")
        return ExitCode(error)
    return 0


def _serve(args: argparse.Namespace) -> None:
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    try:
        with robots.without_gl():
            from . import serve
    except ModuleNotFoundError as error:
        need = 'pip install "jaxpets[play]"'
        raise UsageError(f"{error.name} is not installed; {need} brings it.") from error

    def tell(address: str) -> None:
        print(f"open {address} (Ctrl-C ends it)", flush=True)

    options = serve.Options(**{k: v for k, v in vars(args).items() if k != "debug"})
    serve.serve(options, threading.Event(), tell)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=calling.usage("play"),
        description="Opens a page in the browser: a robot does what it is asked.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add(
        "--from", dest="source", default=_FROM, metavar="MODEL",
        help="pretrained/NAME, the folder of a run, or a file of a model; by default "
        f"{_FROM}",
    )  # fmt: skip
    add("--env", help="the robot; by default that of the model")
    add("--seed", type=int, help="of a run with several; by default the first")
    add(
        "--policy", type=Path, metavar="FILE",
        help="policy-SEED.safetensors of distill, or pretrained/NAME, which can act in "
        "place of the plans; by default that which came with the model, if one did",
    )  # fmt: skip
    add(
        "--horizon", type=_steps, metavar="STEPS",
        help="planned ahead, by default as the model says; fewer are quicker",
    )  # fmt: skip
    add(
        "--watch", type=Path, metavar="RUN",
        help="shows the last trial of a run, and its curves, while it explores",
    )  # fmt: skip
    add("--port", type=int, help="by default 8080, or any that is free")
    add("--host", help="to listen at, as 0.0.0.0; by default this machine alone")
    add("--debug", action="store_true", help="shows tracebacks")
    return parser


def _steps(text: str) -> int:
    if not 1 <= int(text) <= _LONGEST:
        raise argparse.ArgumentTypeError(f"{text} is not 1 to {_LONGEST}")
    return int(text)


if __name__ == "__main__":
    signals.as_program(main)

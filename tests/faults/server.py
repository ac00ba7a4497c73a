"""Runs of `experiments.run` in forked processes: a fault each, and no second import.

Reads a request per line from stdin, a JSON object, and answers each with one:

    argv     of the run
    out      file for what it says on stderr
    root     folder whose file operations meet the fault
    what, at, number   as in fault_arm of shim.c; what 0: no fault
    listed   file for a list of the operations
    signal, after      a signal to send, after seconds; None: none
    limit    seconds until it counts as hung

The answer: `code`, as of subprocess, or None if it hung; `seconds`.
"""

import ctypes
import gc
import json
import os
import signal
import sys
import time
from typing import Any, NoReturn


def child(request: dict[str, Any]) -> NoReturn:
    """Runs one command, which ends the process."""
    from experiments import run, signals

    said = os.open(request["out"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    os.dup2(said, 2)
    os.dup2(os.open(os.devnull, os.O_RDWR), 0)
    os.dup2(0, 1)
    listed = os.open(request["listed"], os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    if request["what"]:
        ctypes.CDLL(None).fault_arm(
            request["root"].encode(),
            request["what"],
            ctypes.c_long(request["at"]),
            request["number"],
            listed,
        )
    sys.argv[1:] = request["argv"]
    signals.as_program(run.main)


def wait(process: int, request: dict[str, Any]) -> int | None:
    """Waits for a child, signals it if that was asked; ends one that hangs."""
    begin = time.monotonic()
    kills = request["signal"]
    while True:
        done, status = os.waitpid(process, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        passed = time.monotonic() - begin
        if kills is not None and passed > request["after"]:
            os.kill(process, kills)
            kills = None
        if passed > request["limit"]:
            os.kill(process, signal.SIGKILL)
            os.waitpid(process, 0)
            return None
        time.sleep(0.005)


def main() -> None:
    # All that a run imports, and none that starts a thread: that would not be forked.
    import experiments.phases
    import experiments.run
    import experiments.storage.folder  # noqa: F401

    # A run gets them also where the bench is under nohup, or a script's background.
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    gc.freeze()
    answers = os.fdopen(os.dup(1), "w")
    print("ready", file=answers, flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        begin = time.monotonic()
        process = os.fork()
        if not process:
            child(request)
        answer = {"code": wait(process, request), "seconds": time.monotonic() - begin}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()

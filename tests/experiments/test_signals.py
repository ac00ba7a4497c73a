"""How a run is stopped: by its first signal, in time, or else without it."""

import asyncio
import contextlib
import logging
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from experiments import signals
from experiments.errors import InterruptedRun
from experiments.progress import Progress, Watch

ROOT = Path(__file__).parents[2]
# A lock that is taken twice: as a program of XLA, it keeps Python from its handlers.
STUCK = """
    import ctypes
    import sys
    from experiments import signals
    with signals.stoppable() as late:
        late.seconds = float(sys.argv[1])
        late.tell = lambda reason: print(f"told {reason}", flush=True)
        mutex = ctypes.create_string_buffer(128)
        print("stuck", flush=True)
        for _ in range(2):
            ctypes.CDLL(None).pthread_mutex_lock(mutex)
"""


# What jax does where it looks for a GPU: nothing that is raised gets through.
DEAF = """
    import os
    import signal
    from experiments import cli, run, signals
    def parse(arguments):
        try:
            os.kill(os.getpid(), signal.SIGINT)
        except BaseException:
            pass
    cli.parse = parse
    signals.as_program(run.main)
"""

# A signal while jax writes a program to its cache, where it forgives every Exception.
CACHING = """
    import os
    import signal
    import sys
    import jax
    from experiments import signals
    from experiments.errors import InterruptedRun
    folder = sys.argv[1]
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    def opening(event, args):
        if event == "open" and str(args[0]).startswith(folder):
            os.kill(os.getpid(), signal.SIGTERM)
    sys.addaudithook(opening)
    try:
        with signals.stoppable():
            jax.jit(lambda x: x + 1)(1)
    except InterruptedRun as error:
        print(error)
"""

# XLA may still be at work on what the frames of a run that was stopped hold.
HELD = """
    from experiments import cli, errors, run, signals
    class Buffer:
        def __del__(self):
            print("freed", flush=True)
    def parse(arguments):
        buffer = Buffer()
        raise errors.InterruptedRun("SIGTERM")
    cli.parse = parse
    signals.as_program(run.main)
"""


@pytest.fixture
def hung_up():
    """Restores what a terminal that closes does to this process."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_stops_what_is_stoppable(name, hung_up):
    number = signal.Signals[name]
    before = signal.getsignal(number)
    with pytest.raises(InterruptedRun, match=name), signals.stoppable():
        try:
            os.kill(os.getpid(), number)
        finally:  # a second signal would end the process, unless a terminal closes
            assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    assert signal.getsignal(number) is before
    assert signal.set_wakeup_fd(-1) == -1


def test_who_forgives_errors_forgives_no_signal():
    with pytest.raises(InterruptedRun, match="SIGTERM"), signals.stoppable():
        with contextlib.suppress(Exception):
            os.kill(os.getpid(), signal.SIGTERM)
        pytest.fail("it goes on")


def test_a_signal_stops_jax_while_it_writes_to_its_cache(tmp_path):
    argv = [sys.executable, "-c", textwrap.dedent(CACHING), str(tmp_path / "cache")]
    found = subprocess.run(
        argv, check=False, cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    assert (found.returncode, found.stdout, found.stderr) == (0, "SIGTERM\n", "")


def test_before_there_is_a_run_nothing_can_swallow_ctrl_c():
    argv = [sys.executable, "-c", textwrap.dedent(DEAF), "explore"]
    found = subprocess.run(
        argv, check=False, cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    assert (found.returncode, found.stdout, found.stderr) == (-signal.SIGINT, "", "")


@pytest.mark.parametrize(
    "words", ["experiments explore --help", "experiments.status tests"]
)
def test_a_reader_who_has_seen_enough_is_no_bug(words):
    """As in `... --help | head`; the exit code is that of a program in C."""
    argv = [sys.executable, "-m", *words.split()]
    reader, writer = os.pipe()
    os.close(reader)
    found = subprocess.run(
        argv, check=False, cwd=ROOT, stdout=writer, stderr=subprocess.PIPE, timeout=60
    )
    os.close(writer)
    assert (found.returncode, found.stderr) == (128 + signal.SIGPIPE, b"")


def test_what_a_stopped_run_holds_is_not_freed():
    argv = [sys.executable, "-c", textwrap.dedent(HELD), "explore"]
    found = subprocess.run(
        argv, check=False, cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    assert (found.returncode, found.stdout) == (75, "")
    assert found.stderr.startswith("stopped: SIGTERM; ")


def test_what_nohup_ignores_stays_ignored(hung_up):
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with signals.stoppable():
        os.kill(os.getpid(), signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


def test_a_signal_that_meets_a_callback_of_asyncio_stops_the_run(caplog):
    async def save():
        loop = asyncio.get_running_loop()
        loop.call_soon(os.kill, os.getpid(), signal.SIGTERM)
        await asyncio.sleep(60)

    with pytest.raises(InterruptedRun, match="SIGTERM"), signals.stoppable():
        asyncio.run(save())
    assert caplog.text == ""


def test_a_loop_stops_at_its_next_tick():
    done = []
    progress = Progress(10, 0, "walk", Watch())
    stopped = pytest.raises(InterruptedRun, match="SIGTERM")
    with stopped, signals.stoppable(), progress.interruptible():
        os.kill(os.getpid(), signal.SIGTERM)
        done.append("the step under way")
        progress.tick(5)
        done.append("the next")
    assert done == ["the step under way"]


def test_a_log_gets_a_line_where_there_was_none_for_a_minute(monkeypatch, capsys):
    now = [100.0]
    clock = SimpleNamespace(monotonic=lambda: now[0])
    monkeypatch.setattr("experiments.progress.time", clock)
    told = []

    def tell(steps_per_second, seconds_left):
        told.append((now[0], round(seconds_left)))

    progress = Progress(1000, 0, "walk", Watch(), tell)

    def ticks(*times):
        for now[0] in times:
            progress.tick(100)
        return capsys.readouterr().err.splitlines()

    said = ["walk 200/1000 steps  [3.3 steps/s, 4.0 min left]"]
    assert ticks(130.0, 160.5, 190.0, 220.0) == said
    progress.line("a trial")
    assert len(ticks(230.0, 270.0)) == 1  # the trial's
    assert len(ticks(290.0)) == 1
    # And what keeps the pace is told it at every tick.
    assert told[:2] == [(130.0, 270), (160.5, 242)] and len(told) == 7


def test_a_tick_that_does_not_come_is_not_waited_for(monkeypatch, capsys):
    told, left = [], threading.Event()
    monkeypatch.setattr(signals, "leave", lambda code: (told.append(code), left.set()))

    def tell(reason):
        told.append(reason)
        raise OSError("the disk is full")  # which keeps nobody

    with signals.stoppable() as late, Progress(10, 0, "walk", Watch()).interruptible():
        late.seconds, late.tell = 0.1, tell
        os.kill(os.getpid(), signal.SIGTERM)
        assert left.wait(20)
    assert told == ["SIGTERM", 75]
    err = capsys.readouterr().err
    assert err.startswith("stopped: SIGTERM; ") and "same command" in err


def test_what_cannot_be_raised_is_not_printed(capsys):
    class Last:
        def __del__(self):
            raise InterruptedRun("SIGTERM")

    with signals.stoppable():
        Last()
    assert capsys.readouterr().err == ""


def test_what_a_thread_of_a_failed_save_logs_later_is_not_shown(caplog):
    caplog.set_level(logging.ERROR, logger="absl")

    def late():
        logging.getLogger("absl").exception("the disk refused what nobody waits for")

    with signals.unheard():
        thread = threading.Thread(target=late)
        thread.start()
        thread.join()
    assert caplog.text == ""
    late()
    assert "the disk refused" in caplog.text


@pytest.mark.parametrize(
    ("seconds", "sent", "code", "said"),
    [
        (0.2, [signal.SIGHUP, signal.SIGHUP], 75, "told SIGHUP\n"),
        (60, [signal.SIGTERM, signal.SIGINT], 128 + signal.SIGINT, ""),
    ],
    ids=["deadline", "second"],
)
def test_a_process_that_is_stuck_ends(seconds, sent, code, said):
    child = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(STUCK), str(seconds)],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert child.stdout is not None
    assert child.stdout.readline() == "stuck\n"
    for number in sent:
        time.sleep(0.05)
        child.send_signal(number)
    out, err = child.communicate(timeout=30)
    assert (child.returncode, out) == (code, said), err
    assert err.startswith("stopped: SIGHUP; ") if code == 75 else err == ""

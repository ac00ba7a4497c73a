"""What is done behind a loop's back: `experiments.behind`."""

import threading
import time

import pytest

from experiments import behind as module
from experiments.behind import behind


def fail():
    raise OSError("no space")


def test_calls_are_in_order_and_done_at_the_end():
    done, here = [], threading.get_ident()

    def work(number):
        time.sleep(0.02)
        done.append((number, threading.get_ident() == here))

    with behind() as saving:
        for number in range(3):
            saving.call(lambda number=number: work(number))
            assert len(done) <= number  # the caller goes on
    assert done == [(0, False), (1, False), (2, False)]


def test_wait_returns_when_the_last_call_has():
    done = []
    with behind() as saving:
        saving.wait()
        saving.call(lambda: (time.sleep(0.05), done.append(1))[0])
        saving.wait()
        assert done == [1]


@pytest.mark.parametrize("next_step", ["wait", "call", "end"])
def test_an_error_comes_at_the_next_step(next_step):
    done = []

    def loop():
        with behind() as saving:
            saving.call(fail)
            if next_step == "wait":
                saving.wait()
                done.append(1)
            if next_step == "call":
                saving.call(lambda: done.append(1))

    with pytest.raises(OSError, match="no space"):
        loop()
    assert not done


def test_check_raises_once_the_call_has_failed_and_does_not_wait():
    go = threading.Event()

    def late():
        go.wait(10)
        fail()

    with behind() as saving:
        saving.check()
        saving.call(late)
        saving.check()
        go.set()
        with pytest.raises(OSError, match="no space"):
            for _ in range(1000):
                time.sleep(0.01)
                saving.check()
        saving.check()  # it is told once


def test_the_callers_error_counts_and_the_call_is_done(capsys):
    done = []

    def work():
        time.sleep(0.05)
        done.append(1)
        fail()

    def loop():
        with behind() as saving:
            saving.call(work)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        loop()
    assert done == [1]
    assert "warning: the last save failed too: OSError: no space" in (
        capsys.readouterr().err
    )


def test_with_other_processes_a_call_is_done_on_return(monkeypatch):
    monkeypatch.setattr(module.distributed, "is_alone", lambda: False)
    done = []
    with behind() as saving:
        saving.call(lambda: (time.sleep(0.02), done.append(1))[0])
        assert done == [1]

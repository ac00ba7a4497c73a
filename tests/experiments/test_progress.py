import os
import signal

import pytest

from experiments.errors import InterruptedRun
from experiments.progress import Progress, stoppable


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_signal_stops_what_is_stoppable(name):
    number = signal.Signals[name]
    before = signal.getsignal(number)
    with pytest.raises(InterruptedRun, match=name), stoppable():
        try:
            os.kill(os.getpid(), number)
        finally:  # a second signal would end the process
            assert signal.getsignal(number) is signal.SIG_DFL
    assert signal.getsignal(number) is before


def test_a_loop_stops_at_its_next_tick():
    done = []
    progress = Progress(10, 0, "walk")
    stopped = pytest.raises(InterruptedRun, match="SIGTERM")
    with stopped, stoppable(), progress.interruptible():
        os.kill(os.getpid(), signal.SIGTERM)
        done.append("the step under way")
        progress.tick(5)
        done.append("the next")
    assert done == ["the step under way"]

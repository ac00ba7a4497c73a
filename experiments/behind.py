"""What is done behind the caller's back: the last call, while the caller goes on."""

import contextlib
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor

from .errors import reason
from .parallel import distributed


class Behind:
    """One thread and its last call."""

    def __init__(self, pool: ThreadPoolExecutor) -> None:
        self._pool = pool
        self._last: Future[None] | None = None

    def call(self, work: Callable[[], None]) -> None:
        """Begins to do this once the last call has returned.

        Where there are other processes it is done on return: all of them must ask each
        other in the same order.
        """
        self.wait()
        self._last = self._pool.submit(work)
        if not distributed.is_alone():
            self.wait()

    def check(self) -> None:
        """Raises what the last call has raised, if it has."""
        if self._last is not None and self._last.done():
            self.wait()

    def wait(self) -> None:
        """Returns when the last call has; what that has raised is raised here."""
        last, self._last = self._last, None
        if last is not None:
            last.result()


@contextlib.contextmanager
def behind() -> Iterator[Behind]:
    """Gives a thread, which is done on return, also where the caller has failed.

    The caller's error counts then, and that of the last call is said.
    """
    with ThreadPoolExecutor(1, "jaxpets-behind") as pool:
        found = Behind(pool)
        try:
            yield found
        except BaseException:
            try:
                found.wait()
            except Exception as error:
                distributed.say(f"warning: the last save failed too: {reason(error)}")
            raise
        found.wait()

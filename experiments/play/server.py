"""A server of viser that keeps to itself."""

import contextlib
import io
from collections.abc import Iterator

import viser


class Server(viser.ViserServer):
    """A server that no visitor can have published elsewhere."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Returns None: viser would open a tunnel to its own site for anybody."""
        del verbose
        return None


@contextlib.contextmanager
def serving() -> Iterator[Server]:
    """Has a server that listens on this machine alone, and says nothing of it."""
    with contextlib.redirect_stdout(io.StringIO()):
        server = Server(host="127.0.0.1", port=0, verbose=False)
    try:
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()

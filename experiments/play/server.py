"""Who may see the page: viser, with a guard at its door.

viser itself lets in whoever reaches its port, and lets them change what they like.
"""

import contextlib
import hmac
import http
import io
import logging
import secrets
import socket
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server as door_of_viser
from viser import _messages

_HERE = ("localhost", "127.0.0.1", "::1")
# What strangers send is not for the terminal.
_SILENT = logging.getLogger(f"{__name__}.silent")
_SILENT.addHandler(logging.NullHandler())
_SILENT.propagate = False


class Server(viser.ViserServer):
    """A server whose visitors are let in by `refusal`, and change only values."""

    def __init__(self, listener: socket.socket, token: str) -> None:
        """Serves.

        Args:
          listener: where it listens; it is closed with the server.
          token: see `refusal`.
        """
        port, plain = listener.getsockname()[1], door_of_viser.serve

        def guarded(
            handler: Any, host: str, port: int, *, process_request: Any, **options: Any
        ) -> Any:
            def admit(connection: Any, request: Any) -> Any:
                reason = refusal(request.path, request.headers, token)
                if reason:
                    return connection.respond(http.HTTPStatus.FORBIDDEN, f"{reason}\n")
                if token:
                    request.path = request.path.removeprefix(f"/{token}")
                return process_request(connection, request)

            del host, port
            options |= {"process_request": admit, "logger": _SILENT, "sock": listener}
            return plain(handler, **options)

        door_of_viser.serve = guarded
        try:
            super().__init__(host="127.0.0.1", port=0, verbose=False)
        finally:
            door_of_viser.serve = plain
        if self.get_port() != port:  # nobody is let in unseen
            self.stop()
            raise RuntimeError(f"viser {viser.__version__} does not open this door")
        self._change_values_only()

    def _change_values_only(self) -> None:
        """Keeps messages from setting other attributes of a control, as they could."""
        gui, kind = self.gui, _messages.GuiUpdateMessage
        update = gui._handle_gui_updates

        async def update_value(client_id: Any, message: Any) -> None:
            if list(message.updates) == ["value"]:
                await update(client_id, message)

        gui._websock_interface.unregister_handler(kind, update)
        gui._websock_interface.register_handler(kind, update_value)

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Returns None: viser would open a tunnel to its own site for anybody."""
        del verbose
        return None


@contextlib.contextmanager
def serving(listener: socket.socket | None = None, token: str = "") -> Iterator[Server]:
    """Has a server that says nothing of itself; without a listener nobody sees it."""
    if listener is None:
        listener, token = socket.create_server(("127.0.0.1", 0)), secrets.token_hex()
    with contextlib.redirect_stdout(io.StringIO()):
        server = Server(listener, token)
    try:
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


def refusal(path: str, headers: Any, token: str) -> str:
    """Returns why a request is refused, "" if it is let in.

    A page of another site may ask a browser to speak to this machine, and may even give
    its own name this machine's address: so who sends a request from a browser must have
    it from this address, and without a token the address must be that of this machine.

    Args:
      path: of the request.
      headers: of the request, a mapping that does not tell cases apart.
      token: the first part of the path must be it; "" for none.
    """
    host, origin = headers.get("Host", ""), headers.get("Origin")
    try:
        name = urlsplit(f"//{host}").hostname
        other = origin is not None and urlsplit(origin).netloc != host
    except ValueError:
        return "This is no request."
    own = path[1:].partition("/")[0].encode("utf-8", "replace")
    if token and not hmac.compare_digest(own, token.encode()):
        return "The address of this page has a token, which the terminal shows."
    if not token and name not in _HERE:
        return "This page is for this machine alone."
    return "This page is not for others to speak to." if other else ""

"""Who may see the page: viser, which asks nobody, behind a proxy that does.

viser listens on this machine alone, at a port that nobody knows. The proxy reads the
head of every request, turns away what has no business here, and passes the rest on.
"""

import asyncio
import contextlib
import hmac
import io
import threading
from collections.abc import Iterator
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import viser
from viser import _messages

_HEAD_BYTES = 16_384
_HEAD_SECONDS = 10.0
_MAX_CONNECTIONS = 64
_HERE = ("localhost", "127.0.0.1", "::1")


class Server(viser.ViserServer):
    """A server of which visitors can change the values of controls, and nothing else.

    viser lets a message set any attribute of a control, for all who look.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
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
def serving() -> Iterator[Server]:
    """Has a server that listens on this machine alone, and says nothing of it."""
    with contextlib.redirect_stdout(io.StringIO()):
        server = Server(host="127.0.0.1", port=0, verbose=False)
    try:
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


class Refusal(NamedTuple):
    """Why a request is not passed on."""

    status: str
    reason: str


def checked(head: bytes, token: str) -> bytes | Refusal:
    """Returns the head of a request as it is passed on, without the token.

    A page of another site may ask a browser to speak to this machine, and may even give
    its own name this machine's address: so who sends a request from a browser must have
    it from this address, and without a token the address must be that of this machine.

    Args:
      head: of an HTTP request, up to and with the empty line.
      token: the first part of the path must be it; "" for none.
    """
    try:
        first, *lines = head.decode("latin-1").rstrip("\r\n").split("\r\n")
        method, path, version = first.split(" ")
        fields = [line.split(":", 1) for line in lines]
        headers = {name.strip().lower(): value.strip() for name, value in fields}
        host = headers.get("host", "")
        name = urlsplit(f"//{host}").hostname
        origin = urlsplit(headers.get("origin", f"//{host}")).netloc
    except ValueError:
        return Refusal("400 Bad Request", "This is no request.")
    if method != "GET" or not path.startswith("/"):
        return Refusal("405 Method Not Allowed", "This page can only be looked at.")
    if token:
        own, _, path = path[1:].partition("/")
        if not hmac.compare_digest(own.encode(), token.encode()):
            reason = "The address of this page has a token, which the terminal shows."
            return Refusal("403 Forbidden", reason)
        path = f"/{path}"
    elif name not in _HERE:
        return Refusal("403 Forbidden", "This page is for this machine alone.")
    if origin != host:
        return Refusal("403 Forbidden", "This page is not for others to speak to.")
    return "\r\n".join([f"{method} {path} {version}", *lines, "", ""]).encode("latin-1")


class Proxy:
    """Passes requests on as long as the process lives, or until it is closed."""

    def __init__(self, host: str, port: int, behind: int, token: str) -> None:
        """Opens it: what comes to `host` and `port` is for the port `behind`.

        Raises:
          OSError: if that cannot be listened at.
        """
        self._behind, self._token, self._count = behind, token, 0
        self._loop = asyncio.new_event_loop()
        opening = asyncio.start_server(self._serve, host, port, limit=_HEAD_BYTES)
        try:
            self._server = self._loop.run_until_complete(opening)
        except OSError:
            self._loop.close()
            raise
        self.port: int = self._server.sockets[0].getsockname()[1]
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Closes it, and every connection."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._server.close()
        tasks = asyncio.all_tasks(self._loop)
        for task in tasks:
            task.cancel()
        if tasks:
            self._loop.run_until_complete(asyncio.wait(tasks))
        self._loop.close()

    async def _serve(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        self._count += 1
        try:
            if self._count > _MAX_CONNECTIONS:
                answer = Refusal("503 Service Unavailable", "Too many are looking.")
            else:
                async with asyncio.timeout(_HEAD_SECONDS):
                    head = await reader.readuntil(b"\r\n\r\n")
                answer = checked(head, self._token)
            if isinstance(answer, Refusal):
                await _refuse(writer, answer)
            else:
                await self._pass_on(answer, reader, writer)
        except (OSError, EOFError, asyncio.LimitOverrunError, TimeoutError):
            pass  # whoever it was is gone, or does not speak HTTP
        except asyncio.CancelledError:
            pass  # it is being closed; asyncio would report a task that was cancelled
        finally:
            self._count -= 1
            writer.close()

    async def _pass_on(
        self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        inner, outer = await asyncio.open_connection("127.0.0.1", self._behind)
        outer.write(head)
        ways = [
            asyncio.create_task(_pipe(reader, outer)),
            asyncio.create_task(_pipe(inner, writer)),
        ]
        try:
            # Nobody listens where one side is silent for good.
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for way in ways:
                way.cancel()
            outer.close()
            await asyncio.gather(*ways, return_exceptions=True)


async def _pipe(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while data := await reader.read(65_536):
        writer.write(data)
        await writer.drain()


async def _refuse(writer: asyncio.StreamWriter, refusal: Refusal) -> None:
    body = f"{refusal.reason}\n".encode()
    head = (
        f"HTTP/1.1 {refusal.status}\r\nContent-Type: text/plain; charset=utf-8\r\n"
        f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n"
    )
    writer.write(head.encode() + body)
    await writer.drain()

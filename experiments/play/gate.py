"""Who may see the page: a door in front of the server, which itself has none.

The server listens on this machine alone, at a port that nobody knows. The door reads
the head of every request, turns away what has no business here, and passes the rest on.
"""

import asyncio
import contextlib
import hmac
import threading
from typing import NamedTuple
from urllib.parse import urlsplit

_HEAD_BYTES = 16_384
_HEAD_SECONDS = 10.0
_MAX_CONNECTIONS = 64
_HERE = ("localhost", "127.0.0.1", "::1")


class Refusal(NamedTuple):
    """Why a request is not passed on."""

    status: str
    reason: str


def passed(head: bytes, token: str) -> bytes | Refusal:
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
    except ValueError:
        return Refusal("400 Bad Request", "This is no request.")
    if method != "GET" or not path.startswith("/"):
        return Refusal("405 Method Not Allowed", "This page can only be looked at.")
    host = headers.get("host", "")
    if token:
        own, _, rest = path[1:].partition("?")[0].partition("/")
        if not hmac.compare_digest(own.encode(), token.encode()):
            reason = "The address of this page has a token, which the terminal shows."
            return Refusal("403 Forbidden", reason)
        path = f"/{rest}"
    elif _name_of(host) not in _HERE:
        return Refusal("403 Forbidden", "This page is for this machine alone.")
    origin = headers.get("origin")
    if origin is not None and urlsplit(origin).netloc != host:
        return Refusal("403 Forbidden", "This page is not for others to speak to.")
    return "\r\n".join([f"{method} {path} {version}", *lines, "", ""]).encode("latin-1")


def _name_of(host: str) -> str | None:
    with contextlib.suppress(ValueError):
        return urlsplit(f"//{host}").hostname
    return None


class Gate:
    """A door that is open as long as the process lives, or until it is closed."""

    def __init__(self, host: str, port: int, behind: int, token: str) -> None:
        """Opens it.

        Args:
          host: to listen at.
          port: to listen at; 0 for any.
          behind: the port of the server, on this machine.
          token: as `passed` takes it.

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
                answer = passed(await _head(reader), self._token)
            if isinstance(answer, Refusal):
                await _refuse(writer, answer)
            else:
                await self._pass_on(answer, reader, writer)
        except (OSError, EOFError, asyncio.LimitOverrunError, TimeoutError):
            pass  # whoever it was is gone, or does not speak HTTP
        finally:
            self._count -= 1
            writer.close()

    async def _pass_on(
        self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        inner, outer = await asyncio.open_connection("127.0.0.1", self._behind)
        try:
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
                await asyncio.gather(*ways, return_exceptions=True)
        finally:
            outer.close()


async def _head(reader: asyncio.StreamReader) -> bytes:
    async with asyncio.timeout(_HEAD_SECONDS):
        return await reader.readuntil(b"\r\n\r\n")


async def _pipe(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while data := await reader.read(65_536):
        writer.write(data)
        await writer.drain()


async def _refuse(writer: asyncio.StreamWriter, refusal: Refusal) -> None:
    body = f"{refusal.reason}\n".encode()
    head = [
        f"HTTP/1.1 {refusal.status}",
        "Content-Type: text/plain; charset=utf-8",
        f"Content-Length: {len(body)}",
        "Connection: close",
    ]
    writer.write("\r\n".join([*head, "", ""]).encode() + body)
    await writer.drain()

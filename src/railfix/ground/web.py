"""Page of the control centre, which shows the line with trains, intervals and authorities, the links, alarms and log.

No log-in is required to read the page; orders require a log-in. The page loads nothing from other servers.
"""

from __future__ import annotations

import asyncio
import json
import secrets
import socket
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any, ClassVar, Final

from railfix.core.extras import needs_extra
from railfix.ground.quic import address_errors

with needs_extra():
    import uvicorn
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import HTMLResponse, JSONResponse, Response, StreamingResponse
    from starlette.routing import Route
    from uvicorn.protocols.http.h11_impl import H11Protocol

#: Time between two events that update the page [s].
EVENT_S: Final = 0.5
#: A log-in ends after this time without an order [s].
SESSION_S: Final = 1800.0
#: Number of wrong passwords from one address within `WRONG_S` after which further log-ins from this address are
#: refused.
MOST_WRONG: Final = 10
#: A login attempt with a wrong password no longer counts after this time [s].
WRONG_S: Final = 60.0
#: A connection whose request stays incomplete is ended after one to two times this time [s].
REQUEST_S: Final = 10.0
#: Largest number of connections; further connections are refused.
MOST_CONNECTIONS: Final = 500
#: Largest number of connections of one peer that have no complete request.
MOST_IDLE: Final = 20
#: Author of the orders of a person who has logged in without a name.
OPERATOR: Final = "operator"
_COOKIE: Final = "railfix-session"
_LONGEST_BODY: Final = 1000
_HEADERS: Final = {
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "connect-src 'self'; img-src data:; form-action 'self'; base-uri 'none'; frame-ancestors 'self'",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}

#: Function that carries out an order: it is called with the values and the author, and returns the reason for a
#: refusal.
Order = Callable[..., str | None]


@dataclass(kw_only=True)
class Sessions:
    """Log-ins of the page.

    `password` is the password of the operator, who logs in without a name; `others` are the passwords of other persons
    and interfaces, by name.
    """

    password: str
    others: Mapping[str, str] = field(default_factory=dict)
    clock: Callable[[], float] = time.monotonic
    _ends: dict[str, float] = field(default_factory=dict)
    _names: dict[str, str] = field(default_factory=dict)
    _wrong: list[tuple[float, str]] = field(default_factory=list)

    def log_in(self, password: str, address: str = "", name: str = "") -> str | None:
        """Open a session and return its token.

        Return None if the password is wrong, or after `MOST_WRONG` wrong passwords from this address.
        """
        now = self.clock()
        self._wrong = [(at, of) for at, of in self._wrong if now - at < WRONG_S]
        self._ends = {token: end for token, end in self._ends.items() if end > now}
        if sum(of == address for _, of in self._wrong) >= MOST_WRONG:
            return None
        known = self.password if not name else self.others.get(name)
        given, right = (text.encode(errors="surrogatepass") for text in (password, known or secrets.token_urlsafe()))
        if not secrets.compare_digest(given, right) or known is None:
            self._wrong.append((now, address))
            return None
        token = secrets.token_urlsafe(32)
        self._ends[token], self._names[token] = now + SESSION_S, name or OPERATOR
        self._names = {known: of for known, of in self._names.items() if known in self._ends}
        return token

    def name_of(self, token: str) -> str:
        """Return the name of a session's owner."""
        return self._names[token]

    def log_out(self, token: str) -> None:
        """End a session."""
        self._ends.pop(token, None)

    def valid(self, token: str) -> bool:
        """Return whether a session is open, and prolong an open session."""
        now = self.clock()
        if self._ends.get(token, -1.0) <= now:
            return False
        self._ends[token] = now + SESSION_S
        return True


def page_app(snapshot: Callable[[], dict[str, Any]], orders: dict[str, Order], *, sessions: Sessions) -> Starlette:
    """Return the web application, which shows the snapshot and accepts each order at ``/orders/NAME``.

    Events with the snapshot are sent until ``done`` in the snapshot is true.
    """
    template = (files("railfix.ground") / "page.html").read_text(encoding="utf-8")
    newest: tuple[float, str, bool] | None = None

    def snapshot_text() -> tuple[str, bool]:
        """Return the snapshot as JSON, computed at most once per `EVENT_S`, and whether this snapshot is the last."""
        nonlocal newest
        now = time.monotonic()
        if newest is None or now - newest[0] >= 0.9 * EVENT_S:
            values = snapshot()
            newest = now, json.dumps(values), bool(values["done"])
        return newest[1:]

    async def page(_: Request) -> Response:
        # "<" in a string would end the script
        state = snapshot_text()[0].replace("<", "\\u003c")
        return HTMLResponse(template.replace("/*STATE*/null", state), headers=_HEADERS)

    async def state(_: Request) -> Response:
        return _answer(snapshot())

    async def stream() -> AsyncIterator[str]:
        while True:
            text, done = snapshot_text()
            yield f"data: {text}\n\n"
            if done:
                return
            await asyncio.sleep(EVENT_S)

    async def events(_: Request) -> Response:
        return StreamingResponse(stream(), media_type="text/event-stream", headers=_HEADERS)

    return Starlette(
        routes=[
            Route("/", page),
            Route("/state", state),
            Route("/events", events),
            *_session_routes(sessions),
            Route("/orders/{name}", partial(_give_order, orders, sessions), methods=["POST"]),
        ]
    )


def _session_routes(sessions: Sessions) -> list[Route]:
    """Return the web routes for log-in and log-out."""

    async def login(request: Request) -> Response:
        values, address = await _values(request), "" if request.client is None else request.client.host
        token = (
            None
            if values is None
            else sessions.log_in(str(values.get("password", "")), address, str(values.get("name", "")))
        )
        if token is None:
            return _answer({"refused": "wrong password, or too many wrong passwords within a minute"}, 403)
        answer = _answer({"refused": None})
        secure = request.url.scheme == "https"
        answer.set_cookie(_COOKIE, token, httponly=True, samesite="strict", secure=secure, max_age=int(SESSION_S))
        return answer

    async def logout(request: Request) -> Response:
        sessions.log_out(request.cookies.get(_COOKIE, ""))
        return _answer({"refused": None})

    return [Route("/login", login, methods=["POST"]), Route("/logout", logout, methods=["POST"])]


async def _give_order(orders: Mapping[str, Order], sessions: Sessions, request: Request) -> Response:
    """Carry out the order that a request names, if the request's session is open."""
    given = orders.get(request.path_params["name"])
    if given is None:
        return _answer({"refused": "there is no such order"}, 404)
    token = request.cookies.get(_COOKIE, "")
    if not sessions.valid(token):
        return _answer({"refused": "log in first"}, 403)
    values = await _values(request)
    if values is None:
        return _answer({"refused": "a JSON object was expected"}, 400)
    reason = given(values, sessions.name_of(token))
    return _answer({"refused": reason}, 200 if reason is None else 409)


def _answer(values: dict[str, Any], status: int = 200) -> JSONResponse:
    return JSONResponse(values, status_code=status, headers=_HEADERS)


async def _values(request: Request) -> dict[str, Any] | None:
    """Return the JSON object of a request; None if the body is no JSON object, or exceeds `_LONGEST_BODY` bytes.

    The content type must be ``application/json``: a page of another site cannot send this type without a preflight
    request, which is refused.
    """
    if request.headers.get("content-type") != "application/json":
        return None
    body = b""
    try:
        async with asyncio.timeout(REQUEST_S):
            async for part in request.stream():
                body += part
                if len(body) > _LONGEST_BODY:
                    return None
        values = json.loads(body)
    except (ValueError, RecursionError, TimeoutError):
        return None
    return values if isinstance(values, dict) else None


class _TimedProtocol(H11Protocol):
    """HTTP protocol that ends connections whose request is not complete in time, even if bytes still arrive.

    At most `MOST_IDLE` connections of a peer wait for a request; if more connections wait, the oldest are closed. A
    peer with many connections therefore blocks neither other peers nor its own next request.
    """

    waiting: ClassVar[dict[tuple[int, str], dict[_TimedProtocol, None]]] = {}

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to check the connection every `REQUEST_S`; close the peer's oldest idle connections."""
        super().connection_made(transport)
        peer = id(self.server_state), self.client[0] if self.client else ""
        mine = self.waiting.setdefault(peer, {})
        mine[self] = None
        idle = [known for known in mine if known.is_idle]
        for oldest in idle[: max(len(idle) - MOST_IDLE, 0)]:
            oldest.transport.close()
        self._peer = peer
        self._look(waited=False)

    def connection_lost(self, exc: Exception | None) -> None:
        """Remove the connection from the peer's connections."""
        mine = self.waiting.get(self._peer, {})
        mine.pop(self, None)
        if not mine:
            self.waiting.pop(self._peer, None)
        super().connection_lost(exc)

    @property
    def is_idle(self) -> bool:
        """Whether no request on this connection is being answered."""
        return self.cycle is None or self.cycle.response_complete

    def _look(self, *, waited: bool) -> None:
        if self.transport.is_closing():
            return
        idle = self.is_idle
        if idle and waited:
            self.transport.close()
        else:
            self.loop.call_later(REQUEST_S, lambda: self._look(waited=idle))


class _Server(uvicorn.Server):
    """Server that leaves signals to the program."""

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Install no signal handlers."""
        yield


class PageServer:
    """Server of the page; port 0 selects a free port, and TLS is used if a certificate and its key are given."""

    def __init__(
        self, app: Starlette, *, host: str = "127.0.0.1", port: int = 0, certificate: tuple[Path, Path] | None = None
    ) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            with address_errors(host, port):
                self._socket.bind((host, port))
        except OSError:
            self._socket.close()
            raise
        secured = {} if certificate is None else {"ssl_certfile": certificate[0], "ssl_keyfile": str(certificate[1])}
        address = "{}:{}".format(*self._socket.getsockname()[:2])
        self.url = f"{'https' if secured else 'http'}://{address}/"
        settings: dict[str, Any] = {"log_level": "error", "lifespan": "off", "timeout_graceful_shutdown": 1, **secured}
        settings |= {"http": _TimedProtocol, "limit_concurrency": MOST_CONNECTIONS}
        self._server = _Server(uvicorn.Config(app, **settings))
        self._task: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Start the server, and wait until it accepts connections."""
        self._task = asyncio.create_task(self._server.serve(sockets=[self._socket]))
        while not self._server.started:
            await asyncio.sleep(0.01)

    async def stop(self) -> None:
        """End the server."""
        self._server.should_exit = True
        if self._task is not None:
            await self._task
        self._socket.close()

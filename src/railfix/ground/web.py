"""Page of the control centre: the line with trains, intervals and authorities, links, alarms and log.

Reading is open; orders need the password. Nothing comes from outside the server.
"""

from __future__ import annotations

import asyncio
import json
import secrets
import socket
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager
from importlib.resources import files
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route

#: Time between two events of the page [s].
EVENT_S = 0.5
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "connect-src 'self'; img-src data:; form-action 'self'; base-uri 'none'; frame-ancestors 'self'",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


def page_app(snapshot: Callable[[], dict[str, Any]], release: Callable[[], str | None], *, password: str) -> Starlette:
    """Return the web application.

    Parameters
    ----------
    snapshot : callable
        Plain values for the page; ``done`` ends its events.
    release : callable
        Releases a stop; returns the reason of a refusal.
    password : str
        Asked for with every order.
    """
    template = (files("railfix.ground") / "page.html").read_text(encoding="utf-8")

    async def page(_: Request) -> Response:
        # "<" in a string would end the script
        state = json.dumps(snapshot()).replace("<", "\\u003c")
        return HTMLResponse(template.replace("/*STATE*/null", state), headers=_HEADERS)

    async def state(_: Request) -> Response:
        return JSONResponse(snapshot(), headers=_HEADERS)

    async def stream() -> AsyncIterator[str]:
        while True:
            values = snapshot()
            yield f"data: {json.dumps(values)}\n\n"
            if values["done"]:
                return
            await asyncio.sleep(EVENT_S)

    async def events(_: Request) -> Response:
        return StreamingResponse(stream(), media_type="text/event-stream", headers=_HEADERS)

    async def order(request: Request) -> Response:
        body = await request.body()
        if len(body) > 1000 or not secrets.compare_digest(body, password.encode()):
            return JSONResponse({"refused": "wrong password"}, status_code=403, headers=_HEADERS)
        reason = release()
        return JSONResponse({"refused": reason}, status_code=200 if reason is None else 409, headers=_HEADERS)

    return Starlette(
        routes=[
            Route("/", page),
            Route("/state", state),
            Route("/events", events),
            Route("/release", order, methods=["POST"]),
        ]
    )


class _Server(uvicorn.Server):
    """Server that leaves signals to the program."""

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Do nothing."""
        yield


class PageServer:
    """Server of the page on a loopback address.

    Parameters
    ----------
    app : Starlette
    host : str
    port : int
        0 takes a free one.

    Attributes
    ----------
    url : str
    """

    def __init__(self, app: Starlette, *, host: str = "127.0.0.1", port: int = 0) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._socket.bind((host, port))
        self.url = "http://{}:{}/".format(*self._socket.getsockname()[:2])
        self._server = _Server(uvicorn.Config(app, log_level="error", lifespan="off", timeout_graceful_shutdown=1))
        self._task: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Serve until `stop`."""
        self._task = asyncio.create_task(self._server.serve(sockets=[self._socket]))
        while not self._server.started:
            await asyncio.sleep(0.01)

    async def stop(self) -> None:
        """End the server."""
        self._server.should_exit = True
        if self._task is not None:
            await self._task
        self._socket.close()

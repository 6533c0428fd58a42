"""Who may ask the server for what: a token where it is exposed, nothing from other sites, uploads of bounded size."""

from __future__ import annotations

import secrets
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from vggtjax.app.limits import Limits
from vggtjax.app.uploads import make_space
from vggtjax.errors import InputError

LOOPBACK = ("127.0.0.1", "localhost", "::1")
_UPLOAD = "/gradio_api/upload"
# What gradio would serve besides the page: files of this machine, addresses of other machines, its description.
_CLOSED = tuple(
    f"{prefix}/{name}"
    for prefix in ("", "/gradio_api")
    for name in ("file=", "proxy=", "info", "openapi", "component_server", "stream", "monitoring", "mcp", "dev")
)
# Everything comes from this server: no fonts, scripts or reports elsewhere. The page's framework needs inline scripts.
_POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; object-src 'none'; base-uri 'self'; "
    "form-action 'self'; frame-ancestors 'self'"
)
_SANDBOX = "; sandbox allow-scripts allow-downloads"  # pages of results, in a tab of their own too


class Guard:
    """Wraps the app (ASGI): refuses what is not allowed before the app sees it."""

    def __init__(self, app: ASGIApp, *, uploads: Path, limits: Limits, token: str | None, port: int) -> None:
        """Without a `token`, only requests to this machine's own names are answered."""
        self._app, self._uploads, self._limits, self._token = app, uploads, limits, token
        self._cookie = f"vggtjax-{port}"  # browsers share cookies among the ports of a machine

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
        elif scope["type"] == "http":
            answer = self._refusal(scope) or await self._upload_refusal(scope)
            await (answer or self._app)(scope, receive, _with_headers(scope, send))
        # no web sockets: the page uses none

    def _refusal(self, scope: Scope) -> ASGIApp | None:
        headers = Headers(scope=scope)
        if self._token is None:
            if _host_name(headers.get("host", "")) not in LOOPBACK:
                return _text(403, "This app answers on this machine only; start it with --host to use it from others.")
        elif not self._is_known(headers):
            given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
            if not secrets.compare_digest(given.encode(), self._token.encode()):
                return _text(401, "This app needs its token: open the address that its terminal shows, to the end.")
            answer = RedirectResponse(".", status_code=303)  # the address without the token
            answer.set_cookie(self._cookie, self._token, httponly=True, samesite="lax")
            return answer
        if scope["method"] not in ("GET", "HEAD") and headers.get("sec-fetch-site", "none") == "cross-site":
            return _text(403, "This request came from another site.")
        if scope["path"].startswith(_CLOSED):
            return _text(404, "There is nothing here.")
        return None

    async def _upload_refusal(self, scope: Scope) -> ASGIApp | None:
        if not scope["path"].startswith(_UPLOAD) or scope["method"] != "POST":
            return None
        length = Headers(scope=scope).get("content-length", "")
        if not length.isdecimal():
            return _text(411, "The upload does not say how long it is.")
        try:
            await run_in_threadpool(make_space, self._uploads, int(length), self._limits)
        except InputError as error:
            return _text(413, str(error))
        return None

    def _is_known(self, headers: Headers) -> bool:
        cookie: SimpleCookie = SimpleCookie()
        try:
            cookie.load(headers.get("cookie", ""))
        except CookieError:
            return False
        given = cookie[self._cookie].value if self._cookie in cookie else ""
        return secrets.compare_digest(given.encode(), (self._token or "").encode())


def _with_headers(scope: Scope, send: Send) -> Send:
    policy = _POLICY + (_SANDBOX if scope["path"].startswith("/results/") else "")

    async def sent(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            headers["content-security-policy"] = policy
            headers["referrer-policy"] = "no-referrer"
            headers["x-content-type-options"] = "nosniff"
        await send(message)

    return sent


def _host_name(host: str) -> str:
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def _text(status: int, text: str) -> Any:
    return PlainTextResponse(f"{text}\n", status_code=status)

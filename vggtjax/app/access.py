"""Who may ask the server for what: a token where it is exposed, nothing from other sites, only what the page needs."""

from __future__ import annotations

import re
import secrets
from collections.abc import Mapping
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from vggtjax.app.posted import MOST_BYTES, cleaned
from vggtjax.app.space import Space
from vggtjax.errors import InputError

LOOPBACK = ("127.0.0.1", "localhost", "::1")
_UPLOAD = "/gradio_api/upload"
_POSTED = ("/gradio_api/queue/join", "/gradio_api/run/predict")
# All that the page asks for. Gradio would also serve files of this machine and of others, and much else.
_READ = re.compile(
    r"/|/favicon\.ico|/theme\.css|/(assets|static|results)/.+"
    r"|/gradio_api/(queue/data|upload_progress|heartbeat/[A-Za-z0-9]{1,64})"
)
# Everything comes from this server: no fonts, scripts or reports elsewhere. The page's framework needs inline scripts.
_POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; object-src 'none'; base-uri 'self'; "
    "form-action 'self'; frame-ancestors 'self'"
)
_SANDBOX = "; sandbox allow-scripts allow-downloads"  # pages of results, in a tab of their own too


class Guard:
    """Wraps the app (ASGI): refuses what is not allowed before the app sees it."""

    def __init__(self, app: ASGIApp, space: Space, inputs: Mapping[int, int], token: str | None, port: int) -> None:
        """`inputs` has the number of values of each of the page's functions.

        Without a `token`, only requests to this machine's own names are answered.
        """
        self._app, self._space, self._inputs, self._token = app, space, inputs, token
        self._cookie = f"vggtjax-{port}"  # browsers share cookies among the ports of a machine

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
        elif scope["type"] == "http":
            answer = self._refusal(scope) or self._for_path(scope)
            await answer(scope, receive, _with_headers(scope, send))
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
        return None

    def _for_path(self, scope: Scope) -> ASGIApp:
        path, method = scope["path"], scope["method"]
        if method in ("GET", "HEAD") and _READ.fullmatch(path):
            if path == "/":
                scope["query_string"] = b""  # gradio would read a state of its own from there
            return self._app
        if method == "POST" and path == _UPLOAD:
            return self._upload
        return self._posted if method == "POST" and path in _POSTED else _NOTHING

    async def _upload(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = Headers(scope=scope)
        length = headers.get("content-length", "")
        if not length.isdecimal() or "transfer-encoding" in headers:
            await _text(411, "The upload does not say how long it is.")(scope, receive, send)
            return
        try:
            await run_in_threadpool(self._space.reserve, int(length))
        except InputError as error:
            await _text(413, str(error))(scope, receive, send)
            return
        try:
            await self._app(scope, receive, send)
        finally:
            self._space.release(int(length))

    async def _posted(self, scope: Scope, receive: Receive, send: Send) -> None:
        body, is_whole = b"", False
        while not is_whole and len(body) <= MOST_BYTES:
            message = await receive()
            if message["type"] == "http.disconnect":
                return
            body += message.get("body", b"")
            is_whole = not message.get("more_body", False)
        if len(body) > MOST_BYTES:
            await _text(413, "This request is too long.")(scope, receive, send)
            return
        try:
            body = cleaned(body, self._inputs)
        except InputError as error:
            await _text(400, str(error))(scope, receive, send)
            return
        headers = MutableHeaders(scope=scope)
        headers["content-length"], headers["content-type"] = str(len(body)), "application/json"
        del headers["transfer-encoding"]
        messages: list[Message] = [{"type": "http.request", "body": body}]

        async def received() -> Message:
            return messages.pop() if messages else await receive()

        await self._app(scope, received, send)

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


_NOTHING = _text(404, "There is nothing here.")

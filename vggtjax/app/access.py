"""Who may ask the server for what: the door, nothing from other sites, only what the page needs, bounded uploads."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from vggtjax.app.uploads import room_for
from vggtjax.viewer.door import Door

_UPLOADS = 8  # of the largest size are on the disk together
_FORM = 2**20  # bytes around the files of an upload, and of any other request
# All that the page asks for. Gradio would also serve files of this machine, and much else.
_READ = re.compile(
    r"/|/favicon\.ico|/theme\.css|/(assets|static|results)/.+"
    r"|/gradio_api/(queue/data|upload_progress|heartbeat/[A-Za-z0-9]{1,64})"
)
_POSTED = re.compile(r"/gradio_api/(upload|queue/join|run/predict)")
# Everything comes from this server: no fonts, scripts or reports elsewhere. The page's framework needs inline scripts.
_POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; object-src 'none'; base-uri 'self'; "
    "form-action 'self'; frame-ancestors 'self'"
)
_SANDBOX = "; sandbox allow-scripts allow-downloads"  # pages of results, in a tab of their own too


class Guard:
    """Wraps the app (ASGI): refuses what is not allowed before the app sees it."""

    def __init__(self, app: ASGIApp, door: Door, upload_bytes: int, uploads: Path) -> None:
        self._app, self._door, self._upload_bytes, self._uploads = app, door, upload_bytes, uploads

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
        elif scope["type"] == "http":
            answer = self._refusal(scope, Headers(scope=scope)) or self._app
            await answer(scope, receive, _with_headers(scope, send))
        # no web sockets: the page uses none

    def _refusal(self, scope: Scope, headers: Headers) -> ASGIApp | None:
        query = scope["query_string"].decode("latin-1")
        admitted = self._door.admits(headers.get("host", ""), query, headers.get("cookie", ""))
        if admitted == "closed":
            return _text(403, self._door.refusal(headers.get("host", "")))
        if admitted == "enter":  # to the address without the token
            return RedirectResponse(".", status_code=303, headers={"set-cookie": self._door.cookie})
        path = scope["path"]
        if scope["method"] in ("GET", "HEAD") and _READ.fullmatch(path):
            if path == "/":
                scope["query_string"] = b""  # gradio would read a state of its own from there
            return None
        if scope["method"] != "POST" or not _POSTED.fullmatch(path):
            return _text(404, "There is nothing here.")
        if headers.get("sec-fetch-site", "none") == "cross-site":
            return _text(403, "This request came from another site.")
        length = headers.get("content-length", "")
        if not length.isdecimal() or "transfer-encoding" in headers:
            return _text(411, "The request does not say how long it is.")
        most = _FORM + (self._upload_bytes if path.endswith("upload") else 0)
        if int(length) > most:
            return _text(413, f"The request has {int(length) / 1e6:.1f} MB; send at most {most / 1e6:.1f} MB.")
        if path.endswith("upload") and not room_for(self._uploads, int(length), _UPLOADS * self._upload_bytes):
            return _text(507, "There is no room for more uploads; try again in an hour.")
        return None


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


def _text(status: int, text: str) -> Any:
    return PlainTextResponse(f"{text}\n", status_code=status)

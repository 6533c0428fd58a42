"""Serving one page on one port: on this machine alone, or elsewhere to those who have the token."""

from __future__ import annotations

import secrets
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import NamedTuple
from urllib.parse import urlsplit

from vggtjax.results.viewer.access import Access, listening, token_for

_MARK, _ASKS_NOBODY = '<meta name="page" content="">', "default-src 'none';"  # in client/page.html
_SILENCE = 30  # seconds after which a connection that says nothing is closed


class Shown(NamedTuple):
    """A page, and the tag that tells it from others."""

    page: bytes
    tag: str


class PageServer(ThreadingHTTPServer):
    """Answers "/" with one page and everything else with an error: no file is served.

    On a loopback address no token is needed, and requests that name another host are refused, as those of a foreign
    site would be. On any other address every request must carry the token, as `?token=` or in the cookie that the first
    such request sets.

    Args:
        page: the HTML.
        host: an address of this machine, or a name of it.
        port: 0 takes a free one.

    Raises InputError for a port that is in use or not allowed, or an address that is none of this machine's.
    """

    daemon_threads = True

    def __init__(self, page: str = "", *, host: str = "127.0.0.1", port: int = 8080) -> None:
        self.show(page)
        opened = listening(host, port)
        super().__init__((host, port), _Handler, bind_and_activate=False)
        self.socket.close()
        self.socket, self.server_address = opened, opened.getsockname()
        self.server_name, self.server_port = host, opened.getsockname()[1]
        self.access = Access(host, self.server_port, token_for(host))

    def show(self, page: str) -> None:
        """Serve another page from now on. An open one asks for the tag every few seconds, and is then loaded anew."""
        tag = secrets.token_hex(8)
        page = page.replace(_MARK, _MARK.replace('""', f'"{tag}"'), 1)
        page = page.replace(_ASKS_NOBODY, f"{_ASKS_NOBODY} connect-src 'self';", 1)
        self.shown = Shown(page.encode(), f'"{tag}"')

    def handle_error(self, request: object, client_address: object) -> None:
        """Say nothing of a browser that hangs up."""


class _Handler(BaseHTTPRequestHandler):
    server: PageServer  # pyright: ignore[reportIncompatibleVariableOverride] - made by this server alone
    timeout = _SILENCE
    server_version, sys_version = "vggtjax", ""

    def do_GET(self) -> None:
        address, access = urlsplit(self.path), self.server.access
        host = self.headers.get("Host", "")
        admitted = access.admits(host, address.query, self.headers.get("Cookie", ""))
        if admitted == "closed":
            self._answer(HTTPStatus.FORBIDDEN, f"{access.refusal(host)}\n".encode())
        elif address.path != "/":
            self._answer(HTTPStatus.NOT_FOUND, b"There is only one page here: /\n")
        elif admitted == "enter":
            self._answer(HTTPStatus.SEE_OTHER, b"", **{"Location": ".", "Set-Cookie": access.cookie})
        else:
            shown = self.server.shown
            self._answer(HTTPStatus.OK, shown.page, "text/html", ETag=shown.tag)

    do_HEAD = do_GET  # noqa: N815 - http.server's name

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing: a request's address may hold the token."""

    def _answer(self, status: HTTPStatus, body: bytes, kind: str = "text/plain", **more: str) -> None:
        self.send_response(status)
        headers = {"Content-Type": f"{kind}; charset=utf-8", "Content-Length": str(len(body)), "Connection": "close"}
        headers |= {"Cache-Control": "no-store", "Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff"}
        headers |= {"X-Frame-Options": "SAMEORIGIN", "Cross-Origin-Resource-Policy": "same-origin"}
        for name, value in (headers | more).items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

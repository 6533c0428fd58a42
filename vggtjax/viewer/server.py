"""Serving one page on one port: on this machine alone, or elsewhere to those who have the token."""

from __future__ import annotations

import errno
import ipaddress
import os
import secrets
import socket
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, urlsplit

from vggtjax.errors import InputError

LOOPBACK = "127.0.0.1"
_SILENCE = 30  # seconds after which a connection that says nothing is closed


class PageServer(ThreadingHTTPServer):
    """Answers "/" with one page and everything else with an error: no file is served.

    On a loopback address no token is needed, and requests that name another host are refused, as those of a foreign
    site would be. On any other address every request must carry the token, as `?token=` or in the cookie that the first
    such request sets.

    Args:
        page: the HTML.
        host: an address of this machine, or a name of it.
        port: 0 takes a free one.
        token: for addresses that are not loopback; made by default.

    Raises InputError for a port that is in use or not allowed, or an address that is none of this machine's.
    """

    daemon_threads = True
    allow_reuse_address = os.name != "nt"  # there it would share the port with another program

    def __init__(self, page: str, *, host: str = LOOPBACK, port: int = 8080, token: str | None = None) -> None:
        self.page = page.encode()
        self.token = None if _is_loopback(host) else token or secrets.token_urlsafe(18)
        self.host = host
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        if not 0 <= port <= 65535:
            raise InputError(f"port is {port}; expected 0 to 65535")
        if not host:
            raise InputError(
                "host is empty; give an address, such as 0.0.0.0 for all of this machine, or leave out --host"
            )
        try:
            super().__init__((host, port), _Handler)
        except OSError as error:
            raise InputError(_refusal(error, host, port)) from error

    @property
    def url(self) -> str:
        """Address for a browser, with the token if there is one."""
        host = socket.gethostname() if self.host in ("0.0.0.0", "::") else self.host
        host = f"[{host}]" if ":" in host else host
        return f"http://{host}:{self.server_port}/" + ("" if self.token is None else f"?token={self.token}")

    def handle_error(self, request: object, client_address: object) -> None:
        """Say nothing of a browser that hangs up."""


class _Handler(BaseHTTPRequestHandler):
    server: PageServer  # pyright: ignore[reportIncompatibleVariableOverride] - made by this server alone
    timeout = _SILENCE
    server_version, sys_version = "vggtjax", ""

    def do_GET(self) -> None:
        address = urlsplit(self.path)
        given = parse_qs(address.query).get("token", [""])[0]
        if self.server.token is None:
            if not self._names_this_machine():
                self._refuse(HTTPStatus.FORBIDDEN, "This viewer answers on this machine only.")
                return
        elif not any(_equal(value, self.server.token) for value in (given, self._cookie())):
            self._refuse(HTTPStatus.FORBIDDEN, "Open the whole address that vggtjax printed; it ends with the token.")
            return
        if address.path != "/":
            self._refuse(HTTPStatus.NOT_FOUND, "There is only one page here: /")
        elif given and self.server.token is not None:  # the cookie takes its place, so that it leaves the address bar
            self.send_response(HTTPStatus.SEE_OTHER)
            self.send_header("Location", "/")
            cookie = f"{self._cookie_name()}={self.server.token}; HttpOnly; SameSite=Strict; Path=/"
            self.send_header("Set-Cookie", cookie)
            self._answer(b"", "text/plain")
        else:
            self.send_response(HTTPStatus.OK)
            self._answer(self.server.page, "text/html")

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing: a request's address may hold the token."""

    def _names_this_machine(self) -> bool:
        try:
            host = urlsplit(f"//{self.headers.get('Host', '')}").hostname or ""
        except ValueError:  # of a bracket that is not closed
            return False
        return host == self.server.host or _is_loopback(host)

    def _cookie_name(self) -> str:
        return f"vggtjax_{self.server.server_port}"  # cookies of all ports of a machine are one jar

    def _cookie(self) -> str:
        try:
            morsel = SimpleCookie(self.headers.get("Cookie", "")).get(self._cookie_name())
        except CookieError:
            return ""
        return morsel.value if morsel else ""

    def _refuse(self, status: HTTPStatus, reason: str) -> None:
        self.send_response(status)
        self._answer(f"{reason}\n".encode(), "text/plain")

    def _answer(self, body: bytes, kind: str) -> None:
        headers = {"Content-Type": f"{kind}; charset=utf-8", "Content-Length": str(len(body)), "Connection": "close"}
        headers |= {"Cache-Control": "no-store", "Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff"}
        headers |= {"X-Frame-Options": "SAMEORIGIN", "Cross-Origin-Resource-Policy": "same-origin"}
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)


def _equal(given: str, token: str) -> bool:
    return secrets.compare_digest(given.encode(), token.encode())


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _refusal(error: OSError, host: str, port: int) -> str:
    if error.errno == errno.EADDRINUSE:
        return f"port {port} of {host} is in use; give another one with --port, or --port 0 for a free one"
    if error.errno == errno.EACCES:
        return f"port {port} may not be used; give one from 1024 to 65535 with --port"
    return f"host is {host!r}, which is no address of this machine ({error.strerror or error}); leave out --host"

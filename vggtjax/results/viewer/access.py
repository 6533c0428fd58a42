"""Who may open what this machine serves: this machine alone, or browsers that bring a token once."""

from __future__ import annotations

import errno
import ipaddress
import secrets
import socket
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from typing import Literal
from urllib.parse import parse_qs, urlsplit

from vggtjax.errors import InputError, one_line


def listening(host: str, port: int) -> socket.socket:
    """Return a socket that listens; port 0 takes a free one. Raises InputError for a port or host that it cannot."""
    if not 0 <= port <= 65535:
        raise InputError(f"port is {port}; expected 0 to 65535")
    if not host:
        raise InputError("host is empty; give an address, such as 0.0.0.0 for all of this machine, or leave out --host")
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((host, port), family=family)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            reason = f"port {port} of {host} is in use; give another one with --port, or --port 0 for a free one"
        elif error.errno == errno.EACCES:
            reason = f"port {port} may not be used; give one from 1024 to 65535 with --port"
        else:
            reason = f"host is {host!r}, no address of this machine ({error.strerror or error}); leave out --host"
        raise InputError(reason) from error


@dataclass(frozen=True)
class Access:
    """The one address of a server. Without a token it opens to requests that name this machine or `host`."""

    host: str
    port: int
    token: str | None

    @property
    def url(self) -> str:
        """The address for a browser, with the token if there is one; of every interface, this machine's name."""
        host = socket.gethostname() if self.host in ("0.0.0.0", "::") else self.host
        host = f"[{host}]" if ":" in host else host
        return f"http://{host}:{self.port}/" + ("" if self.token is None else f"?token={self.token}")

    def refusal(self, host: str) -> str:
        """Return what a request under the name `host` that may not pass is told."""
        if self.token is not None:
            return (
                "Open the whole address that vggtjax printed, with ?token= at its end; under another name keep that end"
            )
        return (
            f"This server answers to this machine alone, as {self.url}, and was asked as {one_line(host, 80) or '?'}. "
            f"Open {self.url} on this machine, after ssh -L {self.port}:localhost:{self.port} if it is elsewhere. For "
            "another name, as behind a proxy, start it again with --host 0.0.0.0: the address that it prints then ends "
            "with ?token=..., which every name needs."
        )

    @property
    def cookie(self) -> str:
        """What keeps the token in a browser; browsers share cookies among the ports of a machine."""
        return f"vggtjax_{self.port}={self.token}; HttpOnly; SameSite=Lax; Path=/"

    def admits(self, host: str, query: str, cookies: str) -> Literal["closed", "open", "enter"]:
        """Return whether a request may pass: "enter" brings the token in the address, which `cookie` shall replace."""
        if self.token is None:  # a site that points its name at this machine is refused
            try:
                name = urlsplit(f"//{host}").hostname or ""
            except ValueError:  # of a bracket that is not closed
                return "closed"
            return "open" if name == self.host or is_loopback(name) else "closed"
        try:
            kept = SimpleCookie(cookies).get(f"vggtjax_{self.port}")
        except CookieError:
            kept = None
        if self._is_token(parse_qs(query).get("token", [""])[0]):
            return "enter"
        return "open" if kept is not None and self._is_token(kept.value) else "closed"

    def _is_token(self, given: str) -> bool:
        return secrets.compare_digest(given.encode(), (self.token or "").encode())


def is_loopback(host: str) -> bool:
    """Return whether a host is this machine alone."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def token_for(host: str) -> str | None:
    """Return a new token where other machines reach the host."""
    return None if is_loopback(host) else secrets.token_urlsafe(18)

"""A web server of a folder, and the memory of fsspec, for tests of URLs."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import BaseHTTPRequestHandler, SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import fsspec


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:
        pass


@contextmanager
def served(what: Path | type[BaseHTTPRequestHandler]) -> Iterator[str]:
    """Serve a folder, or by a handler; yields the URL."""
    handler = partial(_Quiet, directory=str(what)) if isinstance(what, Path) else what
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=partial(server.serve_forever, poll_interval=0.02), daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()


@contextmanager
def empty_memory() -> Iterator[Any]:
    """Yield fsspec's file system in memory, empty before and after."""
    system = fsspec.filesystem("memory")
    try:
        system.store.clear()
        system.pseudo_dirs[:] = [""]
        yield system
    finally:
        system.store.clear()
        system.pseudo_dirs[:] = [""]

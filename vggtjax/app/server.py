"""The server of the app: one process, one port, everything from this machine."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import signal
import socket
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from vggtjax.app.jobs import Desk
from vggtjax.app.limits import Limits
from vggtjax.app.models import Models
from vggtjax.errors import InputError, OutputError, whole_number

_CLOSING = 2  # seconds for open connections at the end


@contextmanager
def listening(host: str, port: int) -> Iterator[socket.socket]:
    """Yield a socket that listens. Raises InputError for a port in use, or a host that is not of this machine."""
    if whole_number("port", port, 0) > 65535:
        raise InputError(f"port is {port}; expected at most 65535")
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        opened = socket.create_server((host, port), family=family)
    except OSError as error:
        in_use = error.errno == errno.EADDRINUSE
        advice = "another program uses it; choose another --port" if in_use else f"{error}; check --host and --port"
        raise InputError(f"cannot listen on port {port} of {host}: {advice}") from error
    with opened:
        yield opened


def address(host: str, port: int, token: str | None) -> str:
    """Return the address to open; of every interface, this machine's name."""
    name = socket.gethostname() if host in ("0.0.0.0", "::", "") else host
    name = f"[{name}]" if ":" in name else name
    return f"http://{name}:{port}/" + (f"?token={token}" if token else "")


def needs_token(host: str) -> bool:
    """Return whether others than this machine can reach the host."""
    from vggtjax.app.access import LOOPBACK

    return host not in LOOPBACK


def made_token() -> str:
    return secrets.token_urlsafe(12)


@contextmanager
def bounded_folder() -> Iterator[Path]:
    """Yield a new folder for everything that the app writes, and remove it at the end, also where SIGTERM ends it."""
    try:
        folder = Path(tempfile.mkdtemp(prefix="vggtjax-app-"))
    except OSError as error:
        raise OutputError(f"cannot make a folder for results in {tempfile.gettempdir()}: {error.strerror}") from error
    before = signal.signal(signal.SIGTERM, _interrupt)
    try:
        yield folder
    finally:
        signal.signal(signal.SIGTERM, before)
        shutil.rmtree(folder, ignore_errors=True)


def serve(
    opened: socket.socket, folder: Path, models: Models, limits: Limits, token: str | None, ready: Callable[[], object]
) -> None:
    """Serve the app on a listening socket until the process is interrupted; `ready` is called once it answers."""
    import uvicorn

    port = opened.getsockname()[1]
    desk = Desk(folder, models, limits)

    class Server(uvicorn.Server):
        async def startup(self, *arguments: Any, **options: Any) -> None:
            await super().startup(*arguments, **options)
            ready()

    try:
        application = build_application(desk, token, port)
        config = uvicorn.Config(
            application, log_level="warning", access_log=False, server_header=False, timeout_graceful_shutdown=_CLOSING
        )
        Server(config).run(sockets=[opened])
    except KeyboardInterrupt:  # its normal end
        pass
    finally:
        desk.close()


def build_application(desk: Desk, token: str | None, port: int) -> Any:
    """Return the whole app (ASGI): page, results, and the guard around them."""
    # Before the import: gradio reads them then. It neither reports nor asks anything of other machines.
    os.environ["GRADIO_ANALYTICS_ENABLED"] = "False"
    os.environ["GRADIO_TEMP_DIR"] = str(desk.uploads)
    os.environ["HF_HUB_DISABLE_TELEMETRY"] = "1"
    import gradio as gr
    from fastapi import FastAPI
    from starlette.staticfiles import StaticFiles

    from vggtjax.app.access import Guard
    from vggtjax.app.page import CSS, build_page, theme
    from vggtjax.app.space import Space
    from vggtjax.app.status import RESULTS

    page = build_page(desk)
    page.has_launched = True  # gradio's own check of paths is off before
    application = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    application.mount(f"/{RESULTS}", StaticFiles(directory=desk.results))
    gr.mount_gradio_app(
        application,
        page,
        "/",
        server_name="127.0.0.1",
        server_port=port,
        footer_links=[],
        run_history=False,
        allowed_paths=[],
        show_error=False,
        max_file_size=desk.limits.upload_bytes,
        ssr_mode=False,
        enable_monitoring=False,
        pwa=False,
        mcp_server=False,
        theme=theme(),
        css=CSS,
    )
    inputs = {number: len(function.inputs) for number, function in page.fns.items()}
    return Guard(application, Space(desk.uploads, desk.limits), inputs, token, port)


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt

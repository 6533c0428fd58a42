"""The server of the app: one process, one port, everything from this machine."""

from __future__ import annotations

import os
import signal
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from vggtjax.app.jobs import Desk
from vggtjax.errors import OutputError
from vggtjax.storage.interruption import handled
from vggtjax.viewer.door import Door

_CLOSING = 2  # seconds for open connections at the end


@contextmanager
def bounded_folder() -> Iterator[Path]:
    """Yield a new folder for everything that the app writes, and remove it at the end, also where SIGTERM ends it."""
    try:
        folder = tempfile.TemporaryDirectory(prefix="vggtjax-app-", ignore_cleanup_errors=True)
    except OSError as error:
        raise OutputError(f"cannot make a folder for results in {tempfile.gettempdir()}: {error.strerror}") from error

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    with folder as path:
        try:
            yield Path(path)
        finally:
            signal.signal(signal.SIGTERM, before)


def serve(application: Any, opened: socket.socket) -> None:
    """Serve the app on a listening socket until the process is interrupted."""
    import uvicorn

    config = uvicorn.Config(
        application, log_level="warning", access_log=False, server_header=False, timeout_graceful_shutdown=_CLOSING
    )
    with suppress(KeyboardInterrupt):  # its normal end
        uvicorn.Server(config).run(sockets=[opened])
    handled()


def build_application(desk: Desk, door: Door) -> Any:
    """Return the whole app (ASGI): page, results, and the guard around them."""
    # Before the import: gradio reads them then. It neither reports nor asks anything of other machines.
    os.environ["GRADIO_ANALYTICS_ENABLED"] = "False"
    os.environ["GRADIO_TEMP_DIR"] = str(desk.uploads)
    os.environ["HF_HUB_DISABLE_TELEMETRY"] = "1"
    import gradio as gr
    from fastapi import FastAPI
    from starlette.staticfiles import StaticFiles

    from vggtjax.app.access import Guard
    from vggtjax.app.page import CSS, RESULTS, build_page, theme

    page = build_page(desk)
    page.has_launched = True  # gradio's own check of paths is off before
    application = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    application.mount(f"/{RESULTS}", StaticFiles(directory=desk.results))
    gr.mount_gradio_app(
        application,
        page,
        "/",
        server_name="127.0.0.1",
        server_port=door.port,
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
    return Guard(application, door, desk.limits.upload_bytes, desk.uploads)

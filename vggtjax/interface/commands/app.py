"""The command `vggtjax app`. Imports neither jax nor gradio before it is needed."""

from __future__ import annotations

import os
import signal
import tempfile
from pathlib import Path
from typing import Annotated

import tyro

from vggtjax.errors import InputError, check_extra
from vggtjax.interface.app.limits import Limits
from vggtjax.interface.commands.report import Report
from vggtjax.storage.interruption import handled

_LEAST_PASSWORD = 8  # characters
_SETTINGS = {"GRADIO_ANALYTICS_ENABLED": "False", "HF_HUB_DISABLE_TELEMETRY": "1"}
_Models = Annotated[tuple[str, ...], tyro.conf.arg(metavar="MODEL [MODEL ...]", help_behavior_hint="(default: demo)")]


def app(
    *,
    model: _Models = (),
    host: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "127.0.0.1",
    port: int = 7860,
    password: Annotated[str | None, tyro.conf.arg(metavar="PASSWORD", help_behavior_hint="")] = None,
    limits: Annotated[Limits, tyro.conf.arg(name="limits")] = Limits(),
) -> None:
    """An app in the browser: drop a video, watch the stages, get viewer, film and files.

    Args:
        model: what users may choose, the first by default: a converted .safetensors, a PyTorch checkpoint, or a hub id
            such as facebook/VGGT-1B; "demo", the small demonstration model, always is a choice
        host: address to listen on; with 0.0.0.0 other machines reach the app, which needs a --password then
        port: port to listen on; 0 takes a free one
        password: what people sign in with, as the user vggtjax; at least 8 characters
        limits: what users may ask
    """
    from vggtjax.results.viewer.access import Access, is_loopback, listening

    if password is None and not is_loopback(host):
        raise InputError(
            f"host is {host!r}, which other machines reach: give a --password to sign in with, or leave out --host"
        )
    if password is not None and len(password) < _LEAST_PASSWORD:
        raise InputError(f"password is {len(password)} characters long; expected at least {_LEAST_PASSWORD}")
    check_extra("the app", "app", "gradio")
    from vggtjax.interface.app.run import Runner

    report, runner = Report(), Runner(model, limits)
    with listening(host, port) as opened:  # a port in use is found before the work
        port = opened.getsockname()[1]
        with report.running():
            for name in reversed(runner.names):  # the default last; broken weights are met before the first job
                with report.stage(f"load {name}") as progress:
                    runner.model(name, progress)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl+C
    with tempfile.TemporaryDirectory(prefix="vggtjax-app-", ignore_cleanup_errors=True) as folder:
        os.environ.update(_SETTINGS | {"GRADIO_TEMP_DIR": folder})  # before the import, where gradio reads them
        from vggtjax.interface.app.page import USER, serve

        sign_in = f", and sign in as {USER} with the password" if password else ""
        opening = f"Open {Access(host, port, None).url}{sign_in}  (Ctrl+C ends the app)"
        serve(runner, Path(folder), host, port, password, lambda: report.line(opening))
    handled()

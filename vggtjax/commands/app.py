"""The command `vggtjax app`. Imports neither jax nor gradio before it is needed."""

from __future__ import annotations

from typing import Annotated

import tyro

from vggtjax.app.limits import LEAST_TOKEN, Limits
from vggtjax.commands.report import Report
from vggtjax.errors import InputError, check_extra

_Models = Annotated[tuple[str, ...], tyro.conf.arg(metavar="MODEL [MODEL ...]", help_behavior_hint="(default: demo)")]


def app(
    *,
    model: _Models = (),
    host: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "127.0.0.1",
    port: int = 7860,
    token: Annotated[str | None, tyro.conf.arg(metavar="TOKEN", help_behavior_hint="")] = None,
    limits: Annotated[Limits, tyro.conf.arg(name="limits")] = Limits(),
) -> None:
    """An app in the browser: drop a video, watch the stages, get viewer, film and files.

    Args:
        model: what users may choose, the first by default: a converted .safetensors, a PyTorch checkpoint, or a hub id
            such as facebook/VGGT-1B; "demo", the small demonstration model, always is a choice
        host: address to listen on; with 0.0.0.0 other machines reach the app, and need its token
        port: port to listen on
        token: what a browser must send once, in the address; by default made up where other machines reach the app
        limits: what users may ask
    """
    check_extra("the app", "app", "gradio")
    from vggtjax.app.jobs import Desk
    from vggtjax.app.models import Models
    from vggtjax.app.server import bounded_folder, build_application, serve
    from vggtjax.viewer.door import Door, listening, token_for

    if token is not None and not (token.isascii() and token.isalnum() and len(token) >= LEAST_TOKEN):
        raise InputError(f"token is {token!r}; expected letters and digits, at least {LEAST_TOKEN}")
    report, models = Report(), Models(model)
    with listening(host, port) as opened, bounded_folder() as folder:  # a port in use is found before the work
        with report.running():
            models.check(report.stage)
        door = Door(host, opened.getsockname()[1], token or token_for(host))
        desk = Desk(folder, models, limits)
        try:
            application = build_application(desk, door)
            report.line(f"Open {door.url}  (Ctrl+C ends the app)")
            serve(application, opened)
        finally:
            desk.close()

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
    host: str = "127.0.0.1",
    port: int = 7860,
    token: Annotated[str | None, tyro.conf.arg(help_behavior_hint="")] = None,
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
    from vggtjax.app.models import Models
    from vggtjax.app.server import address, bounded_folder, listening, made_token, needs_token, serve

    if token is not None and not (token.isascii() and token.isalnum() and len(token) >= LEAST_TOKEN):
        raise InputError(f"token is {token!r}; expected letters and digits, at least {LEAST_TOKEN}")
    if token is None and needs_token(host):
        token = made_token()
    report, models = Report(), Models(model)
    with listening(host, port) as opened, bounded_folder() as folder:
        with report.running():
            models.check(report.stage)

        def ready() -> None:
            report.line(f"Open {address(host, opened.getsockname()[1], token)}  (Ctrl+C ends the app)")

        serve(opened, folder, models, limits, token, ready)

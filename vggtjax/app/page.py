"""The page: what to choose on the left, what comes out on the right; below each other on a phone."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import gradio as gr
import msgspec
from gradio.themes import Base, Soft

from vggtjax.app.jobs import Desk, Job, Request
from vggtjax.app.models import DEMO
from vggtjax.errors import InputError
from vggtjax.options import METHODS
from vggtjax.storage.markup import macros

RESULTS = "results"  # the path under which the server serves the folder of results
_LOOK_EVERY = 0.3  # seconds
_CLEAN_UP = (3600, 86400)  # seconds: every hour, uploads of yesterday go
_HTML = macros("app/status.html")
_FRAMES, _LEAST_FRAMES = 16, 2
_MOST_FPS = 30
_TITLE = "vggtjax: a video in, a 4-D scene out"
_INTRODUCTION = (
    "# vggtjax\nDrop a video. You get the **cameras**, the **depth** and a mask of **what moves** in every frame, and "
    "a **4-D point cloud** to fly through: a viewer, a film and all files."
)
_LAYERS = "Picture and depth (red is near) above; confidence (yellow is sure) and what moves below."
_SHEET = "Up to eight frames at a glance. A click opens the picture in full size."
_FILM = "The camera circles the scene while the moving points play."
CSS = (Path(__file__).with_name("page.css")).read_text(encoding="utf-8")


def theme() -> Base:
    """Return the look of the page, with fonts of the user's own system."""
    fonts = ("system-ui", "-apple-system", "Segoe UI", "Roboto", "sans-serif")
    mono = ("ui-monospace", "Menlo", "Consolas", "monospace")
    look = Soft(primary_hue="teal", neutral_hue="slate", font=fonts, font_mono=mono)
    return look.set(
        block_title_background_fill="none",
        block_title_background_fill_dark="none",
        block_title_text_color="*body_text_color",
        block_title_text_color_dark="*body_text_color",
        block_title_padding="0",
        block_label_background_fill="none",
        block_label_background_fill_dark="none",
        block_label_text_color="*body_text_color",
        block_label_text_color_dark="*body_text_color",
    )


def build_page(desk: Desk) -> gr.Blocks:
    """Return the page, whose jobs run at the desk."""
    limits = desk.limits
    with gr.Blocks(title=_TITLE, analytics_enabled=False, fill_width=True, delete_cache=_CLEAN_UP) as page:
        gr.Markdown(_INTRODUCTION, elem_classes="introduction")
        with gr.Row(elem_classes="columns"):
            with gr.Column(scale=2, min_width=320):
                files = gr.File(
                    label="Video, or several pictures",
                    file_count="multiple",
                    file_types=["video", "image"],
                    height=170,
                    elem_id="clip",
                )
                gr.Markdown(
                    f"At most {limits.max_upload_mb} MB, and {limits.max_seconds} s of video.", elem_classes="limits"
                )
                model = gr.Dropdown(
                    list(desk.models.names),
                    value=desk.models.names[0],
                    label="Model",
                    info="“demo” is small and knows generated scenes only; real footage needs VGGT-1B.",
                )
                method = gr.Dropdown(
                    list(METHODS),
                    value="4dvggt-d",
                    label="Method",
                    info="4dvggt-d is the paper's; 4dvggt-m has other masks; vggt is the fastest.",
                )
                frames = gr.Slider(
                    min(_LEAST_FRAMES, limits.max_frames - 1),  # below its greatest
                    limits.max_frames,
                    value=min(_FRAMES, limits.max_frames),
                    step=1,
                    label="Frames",
                    info="More frames see more of the scene, and take more time and memory.",
                )
                fps = gr.Slider(
                    0,
                    _MOST_FPS,
                    value=0,
                    step=0.5,
                    label="Frames per second",
                    info="0 spreads the frames over the whole video; else they are taken from its start.",
                )
                with gr.Row():
                    start = gr.Button("Reconstruct", variant="primary", elem_id="start", min_width=120)
                    cancel = gr.Button("Cancel", variant="stop", visible=False, elem_id="cancel", min_width=80)
                example = gr.Button("Try the demo clip", variant="secondary", elem_id="example")
            with gr.Column(scale=5, min_width=320):
                progress = gr.HTML(_HTML.idle(), elem_id="progress")
                with gr.Column(visible=False, elem_id="results") as results:
                    with gr.Tabs():
                        shown = []
                        for name in ("Viewer", "Film", "Layers", "Sheet"):
                            with gr.Tab(name, render_children=True):
                                shown.append(gr.HTML(elem_id=name.lower()))
                    shown.append(gr.HTML(elem_id="downloads"))
        for block in (files, model, method, frames, fps):
            block.async_move_resource_to_block_cache = _stays  # no address is fetched
        # Every user may wait for a job here; the desk decides whose turn it is.
        outputs = [progress, results, start, example, cancel, *shown]
        listener = {
            "outputs": outputs,
            "concurrency_limit": None,
            "preprocess": False,  # the callbacks check all values, and say what is wrong
            "show_progress": "hidden",
            "api_visibility": "private",
        }
        watched = _Watched(desk)
        start.click(watched.own, [files, model, method, frames, fps], **listener)
        example.click(watched.demo, [method, frames], **listener)
        cancel.click(watched.cancel, None, None, queue=False, show_progress="hidden", api_visibility="private")
        page.unload(watched.leave)
    page.queue(max_size=10 * (limits.max_waiting + 1), api_open=False)
    return page


async def _stays(url_or_file_path: str | Path | None) -> str | None:
    return None if url_or_file_path is None else str(url_or_file_path)


class _File(msgspec.Struct):
    """What counts of an upload's entry."""

    path: str


class _Watched:
    """The page's callbacks."""

    def __init__(self, desk: Desk) -> None:
        self._desk = desk

    async def own(
        self, files: Any, model: Any, method: Any, frames: Any, fps: Any, request: gr.Request
    ) -> AsyncIterator[list[Any]]:
        """Run the user's own clip; files are entries of uploads."""
        if not files:
            yield _changes(_HTML.refusal("no clip yet: drop a video or pictures first, or try the demo clip"))
            return
        async for change in self._watch((files, model, method, frames, fps), request):
            yield change

    async def demo(self, method: Any, frames: Any, request: gr.Request) -> AsyncIterator[list[Any]]:
        """Run the embedded clip with the embedded model."""
        async for change in self._watch(([], DEMO, method, frames, 0), request):
            yield change

    def cancel(self, request: gr.Request) -> None:
        self._desk.cancel(str(request.session_hash))

    def leave(self, request: gr.Request) -> None:
        """Cancel the job of a closed page."""
        self._desk.cancel(str(request.session_hash))

    async def _watch(self, values: tuple[Any, ...], request: gr.Request) -> AsyncIterator[list[Any]]:
        try:
            files, model, method, frames, fps = msgspec.convert(values, tuple[list[_File], str, str, int, float])
            asked = Request(tuple(Path(file.path) for file in files), model, method, frames, fps or None)
            job = await asyncio.to_thread(self._desk.submit, asked, str(request.session_hash))
        except msgspec.ValidationError:
            yield _changes(_HTML.refusal("the page sent a value of the wrong kind; load the page again"))
            return
        except InputError as error:
            yield _changes(_HTML.refusal(str(error)))
            return
        try:
            while not job.is_over:
                yield _changes(_HTML.status(job, self._desk.ahead(job), time.monotonic()), is_open=True)
                await asyncio.sleep(_LOOK_EVERY)
            yield _changes(_HTML.status(job, 0, time.monotonic()), job)
        finally:
            job.cancel()  # where the page is closed meanwhile; nothing where the job is over


def _changes(text: str, job: Job | None = None, *, is_open: bool = False) -> list[Any]:
    """Return the values of the page's outputs; results are shown with a job that is done."""
    buttons = [gr.update(interactive=not is_open), gr.update(interactive=not is_open), gr.update(visible=is_open)]
    if job is None or job.outputs is None or job.state != "done":
        return [text, gr.update(visible=False), *buttons, *[gr.update() for _ in range(5)]]
    outputs = job.outputs

    def address(path: Path) -> str:
        """Return the address of a file of the job, below the page's own."""
        return f"{RESULTS}/{quote(path.relative_to(job.folder.parent).as_posix())}"

    return [
        text,
        gr.update(visible=True),
        *buttons,
        _HTML.viewer(address(outputs.viewer)),
        _HTML.video(address(outputs.film), _FILM),
        _HTML.video(address(outputs.layers), _LAYERS),
        _HTML.picture(address(outputs.sheet), _SHEET),
        _HTML.downloads(outputs, address),
    ]

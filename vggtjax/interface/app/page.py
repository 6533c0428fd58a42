"""The page and its server, of gradio's own parts: its queue runs one job at a time, its progress shows the stages."""

from __future__ import annotations

import html
import threading
from collections.abc import Callable
from concurrent.futures import CancelledError
from contextlib import nullcontext
from pathlib import Path
from typing import Any
from urllib.parse import quote

import gradio as gr
from gradio.themes import Default
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Receive, Scope, Send

from vggtjax.interface.app.run import DEMO, Runner, sentence
from vggtjax.options import METHODS

USER = "vggtjax"  # the name to sign in with
_DAY = (3600, 86400)  # seconds: every hour, uploads and results of yesterday go
_PROGRESS = gr.Progress()
_INTRODUCTION = """# vggtjax: a video in, a 4-D scene out
You get the **cameras**, the **depth** and a mask of **what moves** in every frame, and a **4-D point cloud** to fly
through: a viewer that opens offline, a film, the layers frame by frame, and a zip of all files."""
_MODELS = "“demo” is small and knows generated scenes only; real footage needs Depth Anything 3 or VGGT-1B."
_METHODS = "4dvggt-d is the paper's; 4dvggt-m has other masks; vggt is the fastest."
_FPS = "0 spreads the frames over the whole video; else they are taken from its start."
_VIEWER = '<iframe src="gradio_api/file={}" title="3-D viewer" sandbox="allow-scripts allow-downloads"></iframe>'
_OFF = dict.fromkeys(("run_history", "enable_monitoring", "share", "inline", "ssr_mode", "mcp_server"), False)
_PLAIN: Any = {"footer_links": [], "quiet": True, "prevent_thread_lock": True, **_OFF}


class Jobs:
    """Runs the jobs of the page: a cancelled one goes on to its next step, for which the next one waits."""

    def __init__(self, runner: Runner, folder: Path) -> None:
        self.runner, self.folders, self.results = runner, [folder, *runner.folders], folder / "results"
        self._turn, self._owner, self._stop = threading.Lock(), "", threading.Event()

    def run(self, request: gr.Request, files, model, method, frames, fps, progress=_PROGRESS) -> list[Any]:
        """Return the page's outputs of uploaded files, or of `DEMO`, the embedded clip."""
        if not files:
            raise gr.Error("no clip yet: drop a video or pictures first, or try the demo clip", print_exception=False)
        self._stop.set()  # of a job that gradio no longer waits for
        self._owner, self._stop = str(request.session_hash), (stop := threading.Event())

        def on_stage(name: str) -> nullcontext[Any]:
            def advance(done: int, total: int | None) -> None:
                if stop.is_set():
                    raise CancelledError
                progress((done, total) if total else 0, desc=name)

            advance(0, None)
            return nullcontext(advance)

        paths = [] if files == DEMO else [*map(Path, files)]
        try:
            with self._turn:
                facts, shown, offered = self.runner.run(paths, model, method, frames, fps, self.results, on_stage)
        except CancelledError:
            raise gr.Error("cancelled", print_exception=False) from None
        except Exception as error:
            raise gr.Error(html.escape(sentence(error, self.folders)), duration=None, print_exception=False) from None
        viewer, *others = map(str, shown)
        return [facts, gr.Column(visible=True), _VIEWER.format(quote(viewer)), *others, [*map(str, offered)]]

    def stop(self, request: gr.Request) -> None:
        """Cancel the job of a page, where it runs."""
        if request.session_hash == self._owner:
            self._stop.set()

    def close(self) -> None:
        """Cancel the job, and wait for its next step."""
        self._stop.set()
        self._turn.acquire()


def build_page(jobs: Jobs) -> gr.Blocks:
    """Return the page: what to choose on the left, what comes out on the right; below each other on a phone."""
    limits, names, most = jobs.runner.limits, list(jobs.runner.names), jobs.runner.limits.max_frames
    with gr.Blocks(title="vggtjax", analytics_enabled=False, delete_cache=_DAY) as page:
        gr.Markdown(_INTRODUCTION)
        with gr.Row():
            with gr.Column(scale=2, min_width=320):
                files = gr.File(label="Video, or pictures", file_count="multiple", file_types=["video", "image"])
                gr.Markdown(f"At most {limits.max_upload_mb} MB, and {limits.max_seconds} s of video.")
                start = gr.Button("Reconstruct", variant="primary", elem_id="start")
                example = gr.Button("Try the demo clip", elem_id="example")
                cancel = gr.Button("Cancel", variant="stop", elem_id="cancel")
                model = gr.Dropdown(names, value=names[0], label="Model", info=_MODELS)
                method = gr.Dropdown(list(METHODS), value="4dvggt-d", label="Method", info=_METHODS)
                frames = gr.Slider(max(1, min(2, most - 1)), most, min(16, most), step=1, label="Frames")
                fps = gr.Slider(0, 30, 0, step=0.5, label="Frames per second", info=_FPS)
            with gr.Column(scale=5, min_width=320):
                status = gr.Markdown("What comes out is shown here.", elem_id="status", container=True)
                with gr.Column(visible=False) as results:
                    with gr.Tab("Viewer"):
                        viewer = gr.HTML(elem_id="viewer")
                    with gr.Tab("Film"):
                        film = gr.Video(
                            label="The camera swings around the scene", autoplay=True, loop=True, elem_id="film"
                        )
                    with gr.Tab("Layers"):
                        layers = gr.Video(
                            label="Picture, depth, confidence, motion", autoplay=True, loop=True, elem_id="layers"
                        )
                    with gr.Tab("Sheet"):
                        sheet = gr.Image(label="Up to eight frames at a glance", elem_id="sheet")
                    with gr.Tab("Files"):
                        offered = gr.File(label="Everything in a zip, viewer, film", elem_id="downloads")
        listener = {"api_visibility": "private", "show_progress_on": status, "concurrency_id": "job"}
        outputs = [status, results, viewer, film, layers, sheet, offered]
        own: Any = start.click(jobs.run, [files, model, method, frames, fps], outputs, **listener)
        embedded = [gr.State(DEMO), gr.State(DEMO), method, frames, gr.State(0)]
        demo: Any = example.click(jobs.run, embedded, outputs, **listener)
        at_once: Any = {"queue": False, "api_visibility": "private"}
        cancel.click(lambda: "Cancelled.", None, status, cancels=[own, demo], **at_once)
        cancel.click(jobs.stop, **at_once)
        page.unload(jobs.stop)
    return page.queue(max_size=limits.max_waiting, default_concurrency_limit=1, api_open=False)


class NotFromOtherSites:
    """Refuses what pages of other sites post: the browser would send it with the name and password of its user."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or hand it on."""
        if scope.get("method") == "POST" and (b"sec-fetch-site", b"cross-site") in scope["headers"]:
            await PlainTextResponse("this comes from another site", 403)(scope, receive, send)
        else:
            await self._app(scope, receive, send)


def serve(runner: Runner, folder: Path, host: str, port: int, password: str | None, ready: Callable[[], None]) -> None:
    """Serve the app until SIGINT. Without a password, requests must name this machine; no other site can."""
    by_name = Middleware(TrustedHostMiddleware, allowed_hosts=["localhost", "127.0.0.1", "[::1]", host])
    guards = [Middleware(NotFromOtherSites), *([] if password else [by_name])]
    page = build_page(jobs := Jobs(runner, folder))
    try:
        page.launch(
            server_name=f"[{host}]" if ":" in host else host,
            server_port=port,
            auth=(USER, password) if password else None,
            auth_message=f"Sign in as {USER}.",
            max_file_size=runner.limits.max_upload_mb * 1_000_000,
            allowed_paths=[str(jobs.results)],
            app_kwargs={"middleware": guards, "openapi_url": None},
            theme=Default(primary_hue="teal", font=("system-ui", "sans-serif"), font_mono=("monospace",)),
            css_paths=Path(__file__).with_name("page.css"),
            **_PLAIN,
        )
        ready()
        page.block_thread()
    finally:
        jobs.close()
        page.close(verbose=False)

"""What the page shows of a job, as HTML with every text escaped. Knows nothing of gradio."""

from __future__ import annotations

import time
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from vggtjax.app.jobs import Job, Stage

if TYPE_CHECKING:
    from vggtjax.app.outputs import Outputs

RESULTS = "results"  # the path under which the server serves the folder of results


def idle() -> str:
    """Return what comes out, before the first job."""
    kinds = {
        "Viewer": "the scene in 3-D, with a time line; a file that opens offline",
        "Film": "the camera circles the scene while the moving points play",
        "Layers": "depth, confidence and what moves, frame by frame",
        "Zip": "cameras, depth maps, masks and point clouds as files",
    }
    rows = "".join(f"<li><b>{name}</b>: {text}</li>" for name, text in kinds.items())
    return f'<div class="job idle"><b>What comes out</b><ul class="outs">{rows}</ul></div>'


def status(job: Job, ahead: int) -> str:
    """Return the state of a job in one line, and its stages with counts and seconds."""
    heads = {
        "waiting": f"Waiting: {ahead} {'job' if ahead == 1 else 'jobs'} before yours",
        "running": "Stopping at the end of this step" if job.is_cancelled else "Running",
        "done": f"Done in {sum(stage.seconds or 0 for stage in job.stages):.0f} s",
        "failed": "Failed",
        "cancelled": "Cancelled",
    }
    failed = f"<p>{escape(_capitalised(job.message))}.</p>" if job.message else ""
    rows = "".join(_row(stage, is_last=stage is job.stages[-1] and job.state == "running") for stage in job.stages)
    head, rows = f"<b>{heads[job.state]}</b>", f"<ol>{rows}</ol>" if rows else ""
    if job.state == "done":
        head, rows = "", f"<details><summary>{head}</summary>{rows}</details>"
    return f'<div class="job {job.state}" role="status">{head}{failed}{rows}</div>'


def refusal(message: str) -> str:
    """Return the sentence of a request that was not queued."""
    return f'<div class="job failed" role="status"><b>Not started</b><p>{escape(_capitalised(message))}.</p></div>'


def viewer(job: Job, outputs: Outputs) -> str:
    """Return the viewer in a frame that may run scripts and nothing else of this site."""
    address = _address(job, outputs.viewer)
    return (
        f'<iframe class="viewer" src="{address}" title="3-D viewer" sandbox="allow-scripts allow-downloads" '
        f'allow="fullscreen"></iframe><p class="under"><a href="{address}" target="_blank" rel="noopener">Open the '
        "viewer in a tab of its own</a></p>"
    )


def video(job: Job, path: Path, caption: str) -> str:
    """Return a film that plays in a loop."""
    return (
        f'<video class="film" src="{_address(job, path)}" controls autoplay loop muted playsinline></video>'
        f'<p class="under">{escape(caption)}</p>'
    )


def picture(job: Job, path: Path, caption: str) -> str:
    """Return a picture that opens in a tab of its own."""
    address = _address(job, path)
    return (
        f'<a href="{address}" target="_blank" rel="noopener"><img class="film" src="{address}" '
        f'alt="{escape(caption)}"></a><p class="under">{escape(caption)}</p>'
    )


def downloads(job: Job, outputs: Outputs) -> str:
    """Return a line about the result, and the links to its files."""
    size = outputs.archive.stat().st_size / 1e6
    note = f'<p class="note">{escape(_capitalised(outputs.note))}.</p>' if outputs.note else ""
    return (
        f'<div class="downloads"><p>{escape(outputs.facts)}</p>{note}<a class="button" download '
        f'href="{_address(job, outputs.archive)}">Download everything (zip, {size:.1f} MB)</a> '
        f'<a class="button plain" target="_blank" rel="noopener" href="{_address(job, outputs.report)}">Report</a> '
        f'<a class="button plain" download href="{_address(job, outputs.film)}">Film (mp4)</a> '
        f'<a class="button plain" download href="{_address(job, outputs.viewer)}">Viewer (html)</a></div>'
    )


def _row(stage: Stage, *, is_last: bool) -> str:
    seconds = time.monotonic() - stage.started if stage.seconds is None else stage.seconds
    name = f"{stage.name} (once for clips of this shape)" if stage.name.startswith("compile ") else stage.name
    count, bar = "", ""
    if stage.total and stage.total > 1:
        count = f"{stage.done} of {stage.total}"
        bar = f'<div class="bar"><i style="width: {100 * stage.done / stage.total:.0f}%"></i></div>' if is_last else ""
    elif is_last:
        count, bar = (str(stage.done) if stage.done else ""), '<div class="bar unknown"><i></i></div>'
    mark = "now" if is_last else "past" if stage.seconds is not None else "broken"
    return (
        f'<li class="{mark}"><span>{escape(name)}</span><span class="count">{count}</span>'
        f'<span class="seconds">{seconds:.1f} s</span>{bar}</li>'
    )


def _address(job: Job, path: Path) -> str:
    """Return the address of a file of a job, below the page's own."""
    return f"{RESULTS}/{quote(path.relative_to(job.folder.parent).as_posix())}"


def _capitalised(text: str) -> str:
    return text[:1].upper() + text[1:].rstrip(".")

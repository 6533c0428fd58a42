"""The report of a result: one page that opens without a network, with everything in it that it shows."""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8

from vggtjax.cameras import camera_centres
from vggtjax.errors import one_line
from vggtjax.options import METHODS
from vggtjax.results import charts, previews, tracks
from vggtjax.results.archive import ARCHIVE_NAME
from vggtjax.results.result import Result, missing_fields
from vggtjax.results.thumbnail import moving_thumbnail
from vggtjax.storage.arrays import spread_frames
from vggtjax.storage.markup import data_uri, render, webp
from vggtjax.storage.versions import installed_version

REPORT_NAME = "report.html"
_STRIP_FRAMES = 8
_THUMBNAIL, _WIDE = 400, 1200  # longest side of a picture of the strip, and of a drawing; in pixels
_RAMP = np.array([*range(0, 256, 32), 255])  # of 256 colours, the stops of a gradient
_LENGTHS = {
    "metre": "Lengths are in metres.",
    "unit of the poses": "Lengths are in the unit of the given poses.",
    "unit of the capture": "Lengths are in the unit of the capture.",
    "unit of the model": "Lengths are up to one scale per clip.",
}
_LINKS = {
    ARCHIVE_NAME: "the whole result, for Reconstruction.load",
    "scene.glb": "points and cameras, for any 3-D viewer",
    "static.ply": "static points of all frames",
    "frames": "points of each frame",
    "depth": "depth of each frame",
    "confidence": "confidence of each frame",
    "mask": "what moves",
    "instances": "moving objects by number",
    "trajectory.txt": "poses of the cameras, TUM format",
    "intrinsics.txt": "focal lengths and principal points",
    "preview/sheet.png": "the clip on one picture",
    "preview/tracks.mp4": "tracks as a video",
    "tracks.npz": "tracks as arrays",
    "vggt4d": "the files that VGGT4D writes",
}


class ErrorTable(NamedTuple):
    """Errors against exact truth, as text."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""


@dataclass(frozen=True)
class RunFacts:
    """What a report says of the run that made the result, and that is no part of the result itself.

    Attributes:
        seconds: by stage
        errors: where the truth is known
        truth: a picture of the result beside the truth
    """

    seconds: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    errors: ErrorTable | None = None
    truth: UInt8[np.ndarray, "height width 3"] | None = None


def versions() -> dict[str, str]:
    """Return the versions that a result is made with, by name."""
    from vggtjax import __version__

    found = {"vggtjax": __version__, "Python": platform.python_version()}
    found |= {name: installed_version(name) for name in ("jax", "numpy")}
    return {name: said for name, said in found.items() if said is not None}


def report_page(folder: Path, result: Result, facts: RunFacts | None = None) -> str:
    """Return the page; equal results and facts give equal text.

    Args:
        folder: of the result, whose files it links to.
        result: all fields.
        facts: of the run, where known.
    """
    facts = facts or RunFacts()
    title = one_line(str(result.settings.get("clip", "")), 120) or "Reconstruction"
    moving = moving_thumbnail(result)
    stages: dict[str, float] = {}
    for name, seconds in facts.seconds.items():  # every stage that is compiled has a name of its own
        name = "compile" if name.startswith("compile ") else name
        stages[name] = stages.get(name, 0.0) + seconds
    return render(
        "results/report.html",
        title=f"{title}: {result.method}",
        heading=title,
        result=result,
        lacking=", ".join(one_line(name, 40) for name in missing_fields(result)[:20] if result.method not in METHODS),
        moving=None if moving is None else {"film": data_uri(moving.film), "still": data_uri(moving.still)},
        summary=_summary(result),
        lengths=_LENGTHS[result.length_unit],
        strip=_strip(result),
        path_ramp=", ".join(map(charts.path_color, _RAMP / 255)),
        views=charts.camera_views(result),
        tracks=None if result.track_positions is None else data_uri(webp(tracks.track_strip(result), _WIDE)),
        facts=facts,
        truth=None if facts.truth is None else data_uri(webp(facts.truth, _WIDE)),
        confidence_name=_confidence_name(result),
        histogram=charts.confidence_histogram(result),
        stages=stages,
        longest=max(*stages.values(), 1e-9) if stages else 1.0,
        settings=_settings(result),
        files={name: what for name, what in _LINKS.items() if name == ARCHIVE_NAME or (folder / name).exists()},
        W=charts.WIDTH,
        H=charts.HEIGHT,
    )


def _summary(result: Result) -> list[tuple[str, str]]:
    frames, height, width = result.depth.shape
    sizes = sorted({(int(w), int(h)) for h, w in result.source_size.tolist()}, reverse=True)
    objects = int(result.instances.max())
    valid = result.valid_pixels
    centres = camera_centres(result.camera_from_world.astype(np.float64))  # squares of far places are finite
    length = float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())
    rows = [
        ("Frames", f"{frames} of {width} x {height} pixels"),
        ("Source", "{} x {} pixels".format(*sizes[0]) + (f" and {len(sizes) - 1} other sizes" if sizes[1:] else "")),
    ]
    if result.timestamps is not None and frames > 1:
        rows.append(("Time", f"{result.timestamps[0]:.2f} s to {result.timestamps[-1]:.2f} s"))
    moving = f"{result.dynamic_share:.1%} of the pixels, {objects} object{'' if objects == 1 else 's'}"
    rows.append(("Moving", moving if result.has_mask else "-"))
    if valid.any():
        depth, known = spread_frames(result.depth, valid)
        low, middle, high = np.percentile(depth[known][:: max(1, int(known.sum()) // 1_000_000)], (5, 50, 95))
        rows.append(("Depth", f"{middle:.3g} in the middle, 90 % within {low:.3g} to {high:.3g}"))
    rows.append(("Camera path", f"{length:.3g} long"))
    unknown = 1 - float(valid.sum() / result.pictured)
    if unknown > 0:
        rows.append(("No depth", f"{unknown:.2%} of the pixels"))
    if result.track_frames is not None:
        rows.append(("Tracks", f"{len(result.track_frames)}"))
    return rows + [(one_line(name.capitalize(), 40), text) for name, text in list(result.known_facts.items())[:10]]


def _ramp(colors: UInt8[np.ndarray, "256 3"]) -> str:
    return ", ".join("#{:02x}{:02x}{:02x}".format(*color) for color in colors[_RAMP].tolist())


def _confidence_name(result: Result) -> str:
    return "Fused precision" if "fusion" in result.settings else "Confidence"


def _strip(result: Result) -> dict[str, Any]:
    """Return up to eight frames, evenly spread: a row each of pictures, moving objects, depth and confidence."""
    frames = len(result.depth)
    shown = np.linspace(0, frames - 1, min(frames, _STRIP_FRAMES)).round().astype(int).tolist()
    valid = result.valid_pixels
    inverse_range = previews.inverse_depth_range(result.depth, valid)
    log_range = previews.log_confidence_range(result.depth_confidence, valid)
    low, high = (f"{np.exp(value):.3g}" for value in log_range)

    def moving(frame: int) -> UInt8[np.ndarray, "H W 3"]:
        ids = previews.moving_ids(result.dynamic_mask[frame], result.instances[frame])
        return previews.overlay_picture(result.images[frame], ids)

    def depth(frame: int) -> UInt8[np.ndarray, "H W 3"]:
        return previews.depth_picture(result.depth[frame], valid[frame], inverse_range)

    def confidence(frame: int) -> UInt8[np.ndarray, "H W 3"]:
        return previews.color_confidence(result.depth_confidence[frame], valid[frame], log_range)

    def row(
        label: str, what: str, draw: Callable[[int], UInt8[np.ndarray, "H W 3"]], note: str = "", **ramp: str
    ) -> dict[str, Any]:
        pictures = [data_uri(webp(draw(frame), _THUMBNAIL)) for frame in shown]
        return {"label": label, "what": what, "pictures": pictures, "note": note, "ramp": ""} | ramp

    times = result.timestamps
    return {
        "frames": [
            {
                "number": frame,
                "name": result.frame_names[frame],
                "time": "" if times is None else f"  ·  {times[frame]:.2f} s",
            }
            for frame in shown
        ],
        "rows": [
            row("Picture", "picture", lambda frame: result.images[frame]),
            *([row("Moving", "moving objects", moving, f"{result.dynamic_share:.1%}")] if result.has_mask else ()),
            row("Depth", "depth", depth, ramp=_ramp(previews.DEPTH_COLORS), low="far", high="near"),
            row(
                _confidence_name(result),
                "confidence",
                confidence,
                ramp=_ramp(previews.CONFIDENCE_COLORS),
                low=low,
                high=high,
            ),
        ],
    }


def _settings(result: Result) -> list[tuple[str, str]]:
    made_with = result.settings.get("versions")
    hidden = {"clip", "model_note", "missing", "lost", "versions"}
    rows = [(name, value) for name, value in result.settings.items() if name not in hidden]
    rows += list(made_with.items()) if isinstance(made_with, dict) else []
    return [(name, value if isinstance(value, str) else json.dumps(value)) for name, value in rows]

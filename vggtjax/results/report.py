"""The report of a result: one page that opens without a network, with everything in it that it shows."""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import UInt8

from vggtjax.cameras import camera_centres
from vggtjax.errors import one_line
from vggtjax.results import charts, previews, tracks
from vggtjax.results.archive import ARCHIVE_NAME
from vggtjax.results.result import Result, missing_fields
from vggtjax.results.thumbnail import moving_thumbnail
from vggtjax.storage.arrays import spread_frames
from vggtjax.storage.markup import data_uri, element, page, relative_link, table, webp

REPORT_NAME = "report.html"
_STRIP_FRAMES = 8
_THUMBNAIL, _WIDE = 400, 1200  # longest side of a picture of the strip, and of a drawing; in pixels
_MOST_SETTINGS, _MOST_LETTERS = 60, 240
_ABOUT_STRIP = "Click a picture to enlarge it. Colours of depth and confidence have one range for the clip."
_ABOUT_CONFIDENCE = (
    "Share of the pixels of each region, over confidence on a logarithmic axis. Higher is more certain; compare by "
    "rank, not by value."
)
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
    """What a report says of the run that made the result, and that is no part of the result itself."""

    seconds: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    """by stage"""
    errors: ErrorTable | None = None
    """where the truth is known"""
    truth: UInt8[np.ndarray, "height width 3"] | None = None
    """a picture of the result beside the truth"""


def versions() -> dict[str, str]:
    """Return the versions that a result is made with, by name."""
    from vggtjax import __version__

    found = {"vggtjax": __version__, "Python": platform.python_version()}
    for name in ("jax", "numpy"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def report_page(folder: Path, result: Result, facts: RunFacts | None = None) -> str:
    """Return the page; equal results and facts give equal text.

    Args:
        folder: of the result, whose files it links to.
        result: all fields.
        facts: of the run, where known.
    """
    facts = facts or RunFacts()
    title = one_line(str(result.settings.get("clip", "")), 120) or "Reconstruction"
    body = [
        _header(title, result),
        element("div", _moving(result), _summary(result), class_="pair"),
        _strip(result),
        _cameras(result),
        _tracks(result),
        _errors(facts),
        element("div", _histogram(result), _timings(facts), class_="pair"),
        _settings(result),
        _files(folder),
    ]
    return page(f"{title}: {result.method}", *body)


def _header(title: str, result: Result) -> Element:
    lacking = ", ".join(one_line(name, 40) for name in missing_fields(result)[:20])
    return element(
        "header",
        element("h1", title),
        element("p", f"{one_line(result.method, 80)}  ·  model {one_line(result.model_name, 80)}", class_="faint"),
        element("p", f"About the model: {one_line(result.model_note)}.", class_="notice")
        if result.model_note
        else None,
        element("p", f"The source has no {lacking}: plain values stand for them.", class_="notice")
        if lacking
        else None,
    )


def _section(title: str, *children: Element | str | None) -> Element:
    return element("section", element("h2", title), *children)


def _picture(data: bytes, alt: str, **attributes: object) -> Element:
    return element("img", src=data_uri(data), alt=alt, **attributes)


def _moving(result: Result) -> Element | None:
    made = moving_thumbnail(result)
    if made is None:
        return None
    still = element("source", media="(prefers-reduced-motion: reduce)", srcset=data_uri(made.still))
    film = _picture(made.film, "the points of the clip, seen from a camera that swings around them", class_="hero")
    note = "Static points stay, moving points play; the camera swings around the scene."
    return _section("In motion", element("picture", still, film), element("p", note, class_="note"))


def _summary(result: Result) -> Element:
    frames, height, width = result.depth.shape
    sizes = sorted({(int(w), int(h)) for h, w in result.source_size.tolist()}, reverse=True)
    objects = int(result.instances.max())
    valid = result.valid_pixels
    centres = camera_centres(result.camera_from_world.astype(np.float64))  # squares of far places are finite
    length = float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())
    rows: list[tuple[str, str | Element]] = [
        ("Frames", f"{frames} of {width} x {height} pixels"),
        ("Source", "{} x {} pixels".format(*sizes[0]) + (f" and {len(sizes) - 1} other sizes" if sizes[1:] else "")),
    ]
    if result.timestamps is not None and frames > 1:
        rows.append(("Time", f"{result.timestamps[0]:.2f} s to {result.timestamps[-1]:.2f} s"))
    rows.append(("Moving", f"{result.dynamic_share:.1%} of the pixels, {objects} object{'' if objects == 1 else 's'}"))
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
    rows += [(one_line(name.capitalize(), 40), one_line(text)) for name, text in list(result.known_facts.items())[:10]]
    return _section("At a glance", table(rows), element("p", _LENGTHS[result.length_unit], class_="note"))


def _ramp(colors: UInt8[np.ndarray, "256 3"]) -> Element:
    stops = ", ".join("#{:02x}{:02x}{:02x}".format(*color) for color in colors[[*range(0, 256, 32), 255]].tolist())
    return element("span", class_="ramp", style=f"background: linear-gradient(90deg, {stops})")


def _label(name: str, note: str = "", ramp: tuple[UInt8[np.ndarray, "256 3"], str, str] | None = None) -> Element:
    ends = None if ramp is None else element("span", element("span", ramp[1]), element("span", ramp[2]), class_="ends")
    return element("div", element("b", name), note, _ramp(ramp[0]) if ramp else None, ends, class_="label")


def _confidence_name(result: Result) -> str:
    return "Fused precision" if "fusion" in result.settings else "Confidence"


def _strip(result: Result) -> Element:
    """Up to eight frames, evenly spread: a row each of pictures, moving objects, depth and confidence."""
    frames = len(result.depth)
    shown = np.linspace(0, frames - 1, min(frames, _STRIP_FRAMES)).round().astype(int)
    valid = result.valid_pixels
    inverse_range = previews.inverse_depth_range(result.depth, valid)
    log_range = previews.log_confidence_range(result.depth_confidence, valid)

    def moving(frame: int) -> UInt8[np.ndarray, "H W 3"]:
        ids = previews.moving_ids(result.dynamic_mask[frame], result.instances[frame])
        return previews.overlay_picture(result.images[frame], ids)

    low, high = (f"{np.exp(value):.3g}" for value in log_range)
    rows: list[tuple[Element, str, Callable[[int], UInt8[np.ndarray, "H W 3"]]]] = [
        (_label("Picture"), "picture", lambda frame: result.images[frame]),
        (_label("Moving", f"{result.dynamic_share:.1%}"), "moving objects", moving),
        (
            _label("Depth", ramp=(previews.DEPTH_COLORS, "far", "near")),
            "depth",
            lambda frame: previews.depth_picture(result.depth[frame], valid[frame], inverse_range),
        ),
        (
            _label(_confidence_name(result), ramp=(previews.CONFIDENCE_COLORS, low, high)),
            "confidence",
            lambda frame: previews.color_confidence(result.depth_confidence[frame], valid[frame], log_range),
        ),
    ]
    cells = [element("div", class_="label")]
    for frame in shown:
        time = "" if result.timestamps is None else f"  ·  {result.timestamps[frame]:.2f} s"
        cells.append(element("div", f"frame {frame}{time}", title=one_line(result.frame_names[frame], 80)))
    for label, what, draw in rows:
        cells.append(label)
        for frame in shown.tolist():
            drawn = _picture(webp(draw(frame), _THUMBNAIL), f"{what} of frame {frame}")
            box = element("input", type="checkbox", aria_label=f"enlarge the {what} of frame {frame}")
            cells.append(element("label", box, drawn, class_="zoom"))
    columns = f"grid-template-columns: 92px repeat({len(shown)}, minmax(112px, 260px))"
    return _section(
        "Frames",
        element("div", *cells, class_="strip", style=columns),
        element("p", _ABOUT_STRIP, class_="note"),
    )


def _cameras(result: Result) -> Element:
    colors = np.array(
        [tuple(bytes.fromhex(charts.path_color(share)[1:])) for share in np.linspace(0, 1, 256)], np.uint8
    )
    views = charts.camera_views(result)
    return _section(
        "Camera path",
        element("div", element("span", "first frame", _ramp(colors), "last frame"), class_="legend"),
        element("div", *(element("div", element("h3", name), view) for name, view in views), class_="pair"),
        element(
            "p", "Both views have one scale; lengths are up to scale. Grey, where near: static points.", class_="note"
        ),
    )


def _histogram(result: Result) -> Element:
    def key(name: str, text: str) -> Element:
        return element("span", element("span", class_="dot", style=f"background: var(--{name})"), text)

    return _section(
        _confidence_name(result),
        element("div", key("static", "static pixels"), key("moving", "moving pixels"), class_="legend"),
        charts.confidence_histogram(result),
        element("p", _ABOUT_CONFIDENCE, class_="note"),
    )


def _tracks(result: Result) -> Element | None:
    if result.track_positions is None:
        return None
    drawn = _picture(webp(tracks.track_strip(result), _WIDE), "tracks over frames of the clip", class_="drawing")
    return _section("Tracks", element("div", drawn, class_="scroll"))


def _errors(facts: RunFacts) -> Element | None:
    if facts.errors is None:
        return None
    drawn = None
    if facts.truth is not None:
        drawn = _picture(webp(facts.truth, _WIDE), "the result beside the truth", class_="drawing")
    head = element("tr", *(element("th", one_line(heading, 80)) for heading in facts.errors.headings))
    rows = (element("tr", *(element("td", one_line(cell, 80)) for cell in row)) for row in facts.errors.rows)
    return _section(
        "Errors against the truth",
        element("div", element("table", head, *rows, class_="grid"), class_="scroll"),
        *(element("p", one_line(line, 600), class_="note") for line in facts.errors.note.splitlines()),
        None if drawn is None else element("div", drawn, class_="scroll"),
    )


def _timings(facts: RunFacts) -> Element | None:
    if not facts.seconds:
        return None
    stages: dict[str, float] = {}
    for name, seconds in facts.seconds.items():  # every stage that is compiled has a name of its own
        name = "compile" if name.startswith("compile ") else name
        stages[name] = stages.get(name, 0.0) + seconds
    most = max(*stages.values(), 1e-9)
    bars: list[Element] = []
    for name, seconds in stages.items():
        bars += [
            element("span", one_line(name, 60)),
            element("span", class_="bar", style=f"width: {100 * seconds / most:.1f}%"),
            element("span", f"{seconds:.2f} s", class_="value"),
        ]
    total = f"{sum(facts.seconds.values()):.2f} s before the files were written."
    return _section("Time", element("div", *bars, class_="bars"), element("p", total, class_="note"))


def _settings(result: Result) -> Element:
    made_with = result.settings.get("versions")
    hidden = {"clip", "model_note", "missing", "versions"}
    rows = [(name, value) for name, value in result.settings.items() if name not in hidden]
    rows += list(made_with.items()) if isinstance(made_with, dict) else []
    shown: list[tuple[str, str | Element]] = [
        (one_line(name, 60), element("code", _value(value))) for name, value in rows[:_MOST_SETTINGS]
    ]
    left = len(rows) - len(shown)
    more = element("p", f"{left} more are in {ARCHIVE_NAME}.", class_="note") if left else None
    return _section("Settings and versions", table(shown), more)


def _value(value: Any) -> str:
    return one_line(value if isinstance(value, str) else json.dumps(value), _MOST_LETTERS)


def _files(folder: Path) -> Element:
    there = [name for name in _LINKS if name == ARCHIVE_NAME or (folder / name).exists()]
    links = (
        element("li", element("a", name, href=relative_link(*name.split("/"))), f": {_LINKS[name]}") for name in there
    )
    return _section(
        "Files",
        element("ul", *links, class_="links"),
        element("p", "The links work in the folder of the result. The page itself needs no other file.", class_="note"),
    )

"""How fluently the viewer's page plays in a browser: pictures a second of a generated result, and the file's size."""

from __future__ import annotations

import shutil
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from vggtjax.errors import InputError, check_extra
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.viewer.page import Viewer, viewer_page

_FLAGS = (
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)  # no graphics card
_READY = "new Promise(done => { const look = () => window.vggtjax ? done(1) : setTimeout(look, 20); look(); })"
_MEASURE = """async (seconds) => {
    const { viewer } = window.vggtjax;
    const times = [], before = viewer.drawn, started = performance.now();
    await new Promise((done) => {
        const step = (now) => {
            times.push(now);
            performance.now() - started < 1000 * seconds ? requestAnimationFrame(step) : done();
        };
        requestAnimationFrame(step);
    });
    const passed = (performance.now() - started) / 1000;
    const gaps = times.slice(1).map((now, i) => now - times[i]).sort((a, b) => a - b);
    return {
        drawn: (viewer.drawn - before) / passed,
        shown: gaps.length / passed,
        slowest: gaps[Math.floor(0.95 * gaps.length)],
        points: Math.round(viewer.budget),
        pixels: viewer.canvas.width * viewer.canvas.height,
    };
}"""
_TURN = "window.vggtjax.viewer.ontick = () => { window.vggtjax.viewer.orbit.yaw += 0.01; }"


def viewer(
    *,
    frames: int = 300,
    size: str = "518x294",
    seconds: float = 8.0,
    screenshots: Path | None = None,
    with_card: bool = False,
) -> None:
    """Write the page of a generated result and play it in a headless Chromium.

    Args:
        frames: of the result.
        size: of its frames, width x height.
        seconds: of each measurement.
        screenshots: folder for pictures of the page at three frames.
        with_card: draw with the graphics card, where there is one; by default all is drawn by the processor.
    """
    check_extra("measuring the viewer", "dev", "playwright")
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        raise InputError("there is no Chromium on this machine; install it to measure the viewer")
    width, height = _sides(size)
    started = time.perf_counter()
    result = seeded_result(frames, height, width)
    made = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        file = Path(folder) / "viewer.html"
        Viewer(viewer_page([result], names=[f"{frames} frames of {size}"])).save(file)
        seconds_of_page = time.perf_counter() - made
        _say(f"result {made - started:.1f} s, page {seconds_of_page:.1f} s, {file.stat().st_size / 1e6:.1f} MB")
        browser = playwright.chromium.launch(executable_path=chromium, args=[] if with_card else list(_FLAGS))
        page = browser.new_page(viewport={"width": 1120, "height": 680})
        started = time.perf_counter()
        page.goto(file.as_uri())
        page.evaluate(_READY)
        _say(f"opened after {time.perf_counter() - started:.1f} s")
        page.evaluate("window.vggtjax.controls.play(true)")
        page.evaluate("window.vggtjax.viewer.set({ speed: 4 })")  # so that a frame is due at every picture
        page.wait_for_timeout(6000)  # until all points of the background are drawn
        _report("playing", page.evaluate(_MEASURE, seconds))
        page.evaluate(_TURN)
        page.wait_for_timeout(3000)
        _report("playing and turning", page.evaluate(_MEASURE, seconds))
        page.evaluate("window.vggtjax.viewer.ontick = null; window.vggtjax.controls.play(false)")
        for frame in (0, frames // 2, frames - 1) if screenshots is not None else ():
            page.evaluate("frame => window.vggtjax.viewer.show(frame)", frame)
            page.wait_for_timeout(3000)
            page.screenshot(path=Path(screenshots or ".") / f"viewer_{frame:04d}.png")
        browser.close()


def seeded_result(frames: int, height: int, width: int) -> Reconstruction:
    """Return a result of this size: a bowl, a ball that circles before it, a camera that swings."""
    random = np.random.default_rng(0)
    phase = np.linspace(0, 2 * np.pi, frames, endpoint=False)
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    focal = 0.9 * width
    texture = random.integers(60, 200, (height // 8 + 1, width // 8 + 1, 3)).repeat(8, 0).repeat(8, 1)
    depth = np.empty((frames, height, width), np.float32)
    mask = np.zeros((frames, height, width), bool)
    images = np.empty((frames, height, width, 3), np.uint8)
    poses = np.tile(np.eye(3, 4, dtype=np.float32), (frames, 1, 1))
    for frame, angle in enumerate(phase):
        depth[frame] = 5 - 0.8 * (((x - width / 2) / width) ** 2 + ((y - height / 2) / height) ** 2)
        centre = width * (0.5 + 0.25 * np.cos(angle)), height * (0.5 + 0.2 * np.sin(angle))
        inside = 1 - ((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (0.16 * height) ** 2
        mask[frame] = inside > 0
        depth[frame][mask[frame]] = 3 - 0.4 * np.sqrt(inside[mask[frame]])
        images[frame] = texture[:height, :width]
        images[frame][mask[frame]] = (230, 70, 60)
        poses[frame, :, 3] = 0.5 * np.sin(angle), 0.1 * np.cos(angle), 0
    return Reconstruction(
        depth=depth,
        depth_confidence=1 + random.random(depth.shape, np.float32),
        saliency=None,
        dynamic_mask=mask,
        camera_from_world=poses,
        intrinsics=np.tile(
            np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], np.float32), (frames, 1, 1)
        ),
        images=images,
        frame_names=tuple(f"{frame:06d}" for frame in range(frames)),
        timestamps=np.arange(frames) / 24,
        method="4dvggt-d",
        model_name="generated",
        settings={},
        source_size=np.tile([height, width], (frames, 1)),
        source_scale=np.ones((frames, 2)),
        source_offset=np.zeros((frames, 2)),
        valid_box=np.tile([0, 0, width, height], (frames, 1)),
    )


def _sides(size: str) -> tuple[int, int]:
    sides = size.split("x")
    if len(sides) != 2 or not all(side.isdecimal() and 0 < int(side) <= 4096 for side in sides):
        raise InputError(f"size is {size!r}; expected width x height, such as 518x294")
    return int(sides[0]), int(sides[1])


def _report(what: str, measured: dict[str, float]) -> None:
    _say(
        f"{what}: {measured['drawn']:.1f} pictures a second (the browser shows {measured['shown']:.1f}; 95 % of the "
        f"gaps are below {measured['slowest']:.0f} ms), {measured['pixels'] / 1e6:.2f} M pixels, "
        f"at most {measured['points']} points of the background while the view turns"
    )


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()

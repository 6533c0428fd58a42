"""Valid samples for the readers: small files, as the programs write them whose files they are."""

from __future__ import annotations

import json
from collections.abc import Callable
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from tests.captures import folders
from tests.dataset_files import depth_png, png, write
from tests.room import make_room
from vggtjax.clips.clip import Clip, load_clip

SIDE = 28


def pixels(seed: int = 0, height: int = SIDE, width: int = SIDE) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


@cache
def clip() -> Clip:
    """Three frames of noise, as a clip that masks, points and cameras belong to."""
    return load_clip([pixels(seed) for seed in range(3)], size=SIDE)


def picture_file(name: str, **options: Any):
    """Return the maker of one picture in the format that its suffix says."""

    def make(folder: Path) -> Path:
        Image.fromarray(pixels()).save(folder / name, **options)
        return folder / name

    return make


def video_file(suffix: str, codec: str, format: str | None = None):
    """Return the maker of five frames of video in a container."""

    def make(folder: Path) -> Path:
        path = folder / f"video{suffix}"
        with av.open(str(path), "w", format=format) as container:
            stream: Any = container.add_stream(codec, rate=25)
            stream.width, stream.height = 64, 48
            stream.pix_fmt = "rgb8" if codec == "gif" else "yuv420p"
            stream.codec_context.time_base = Fraction(1, 25)
            for number in range(5):
                frame = av.VideoFrame.from_ndarray(pixels(number, 48, 64), format="rgb24")
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
        return path

    return make


def masks(folder: Path) -> Path:
    for number in range(3):
        white = 255 * (pixels(number)[..., 0] > 99)
        write(folder / f"masks/{number:06d}.png", png(white.astype(np.uint8)))
    return folder / "masks"


def capture(writer, *, zipped: bool = False):
    """Return the maker of a capture of an app."""

    def make(folder: Path) -> Path:
        written = writer(folder / "capture", folders.make_truth())
        if not zipped:
            return written
        path = folders.zipped(written, folder / "capture.r3d")
        import shutil

        shutil.rmtree(written)
        return path

    return make


def plain(folder: Path) -> Path:
    for number in range(3):
        write(folder / f"set/rgb/{number}.png", png(pixels(number, 3, 4)))
        write(folder / f"set/depth/{number}.png", depth_png([[1000, 0, 2000, 3000]] * 3))
        write(folder / f"set/mask/{number}.png", png(np.full((3, 4), 255, np.uint8)))
    pose = "1 0 0 {} 0 1 0 0 0 0 1 0 0 0 0 1"
    write(folder / "set/world_from_camera.txt", "\n".join(pose.format(number) for number in range(3)))
    write(folder / "set/K.txt", "5 0 2\n0 5 1.5\n0 0 1\n")
    return folder / "set"


def tum(folder: Path) -> Path:
    lines: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
    for number in range(40):  # Bonn's protocol starts at frame 30
        time = f"{100 + number / 10:.4f}"
        if number in (0, 30):
            write(folder / f"rgbd_bonn_x/rgb/{time}.png", png(pixels(number, 3, 4)))
            write(folder / f"rgbd_bonn_x/depth/{time}.png", depth_png([[5000, 0, 2000, 3000]] * 3))
        for kind in ("rgb", "depth"):
            lines[kind].append(f"{time} {kind}/{'103.0000' if number >= 30 else '100.0000'}.png")
        lines["groundtruth"].append(f"{time} {number} 0 0 0 0 0 1")
    for name, rows in lines.items():
        write(folder / f"rgbd_bonn_x/{name}.txt", "# comment\n" + "\n".join(rows))
    write(folder / "rgbd_bonn_x/calibration.txt", "5 5 2 1.5")
    return folder / "rgbd_bonn_x"


def davis(folder: Path) -> Path:
    for number in range(3):
        place = folder / "set/JPEGImages/480p/bear"
        place.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels(number, 4, 6)).save(place / f"{number:05d}.jpg")
        labels = png(np.ones((4, 6), np.uint8), palette=bytes(9))
        write(folder / f"set/Annotations/480p/bear/{number:05d}.png", labels)
    return folder / "set"


def seven_scenes(folder: Path) -> Path:
    for number in range(3):
        stem = f"set/seq-01/frame-{number:06d}"
        write(folder / f"{stem}.color.png", png(pixels(number, 3, 4)))
        write(folder / f"{stem}.depth.png", depth_png([[1000, 0, 65535, 3000]] * 3))
        write(folder / f"{stem}.pose.txt", f"1 0 0 {number}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    return folder / "set"


def text_file(name: str, content: str | bytes):
    """Return the maker of one file."""
    return lambda folder: write(folder / name, content)


def made(function: Callable[[Path], object], name: str = "set") -> Callable[[Path], Path]:
    """Return the maker of a folder that a function fills."""

    def make(folder: Path) -> Path:
        function(folder / name)
        return folder / name

    return make


def json_file(name: str, value: Any):
    return text_file(name, json.dumps(value))


def archive(folder: Path) -> Path:
    make_room(3).save_archive(folder / "reconstruction.npz")
    return folder / "reconstruction.npz"


def npz(folder: Path) -> Path:
    path = folder / "arrays.npz"
    words = np.array(["a", "b"])
    np.savez_compressed(path, depth=np.ones((4, 6, 8), np.float32), mask=np.ones((3, 4), bool), words=words)
    return path


def manifest(name: str):
    """Return the maker of a list of two clips beside their folders."""

    def make(folder: Path) -> Path:
        for clip_name in ("a", "b"):
            write(folder / clip_name / "0.png", png(pixels()))
        rows = [{"source": "a", "name": "first"}, {"source": "b", "name": "second"}]
        if name.endswith(".parquet"):
            pq.write_table(pa.Table.from_pylist(rows), folder / name)
            return folder / name
        if name.endswith(".csv"):
            text = "source,name\n" + "\n".join(f"{row['source']},{row['name']}" for row in rows)
        else:
            text = "\n".join(map(json.dumps, rows))
        return write(folder / name, text)

    return make

"""Rows of what strangers give: pictures, videos, lists of clips, known cameras and depth, captures, data sets."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from tests.clips.captures import folders
from tests.fuzz.cases import Reader
from tests.research.evaluation.datasets.test_dycheck import dycheck_folder
from tests.research.evaluation.datasets.test_layouts import kitti_folder, scene_folder, sintel_folder
from tests.research.evaluation.datasets.test_open import davis_folder, plain_folder
from tests.research.evaluation.datasets.test_tum import tum_folder
from tests.results.test_foreign import QUATERNIONS, WRITERS
from tests.shared.dataset_files import depth_png, dpt, npy, png, write
from tests.shared.videos import encode
from vggtjax.clips.captures.depth_files import read_dpt, read_exr, read_npy, read_png
from vggtjax.clips.captures.table import read_capture
from vggtjax.clips.clip import Clip, load_clip
from vggtjax.clips.masks import load_masks
from vggtjax.clips.media.images import read_image
from vggtjax.clips.media.sampling import Sampling
from vggtjax.clips.queries import parse_queries
from vggtjax.clips.sources import clips_by_name, open_source
from vggtjax.pipeline.known.depths import read_depths
from vggtjax.pipeline.known.intrinsics import at_clip_pixels, read_intrinsics
from vggtjax.pipeline.known.poses import checked_known_poses, read_poses
from vggtjax.research.evaluation.datasets import find_sequences
from vggtjax.results.reconstruction import Reconstruction

SIDE = 28
_POSES = "".join(f"{number} {number} {number % 2} 0 0 0 0 1\n" for number in range(3))
_CODECS = {  # container -> codec; gif and mxf hold no other
    **dict.fromkeys((".mp4", ".mov", ".mkv", ".avi", ".ts", ".m4v", ".3gp"), "mpeg4"),
    **{".webm": "libvpx", ".ogv": "libvpx", ".mpg": "mpeg1video", ".mxf": "mpeg2video"},
    **{".wmv": "wmv2", ".flv": "flv", ".gif": "gif"},
}
_PICTURES = {  # suffix -> slack: the last ones can hold 16 million pixels in a few hundred bytes
    **dict.fromkeys((".png", ".jpg", ".bmp", ".ppm", ".tga"), 48 * 2**20),
    **dict.fromkeys((".tif", ".webp", ".jp2", ".avif"), 2**28),
}
_VIDEO = 384 * 2**20  # slack: a damaged packet may say 8 million pixels, of which a decoder holds several frames


def file(name: str, content: str | bytes) -> Callable[[Path], Path]:
    """Return the maker of one file."""
    return lambda folder: write(folder / name, content)


def made(function: Callable[[Path], object], name: str = "set") -> Callable[[Path], Path]:
    """Return the maker of a folder that a function fills."""
    return lambda folder: (function(folder / name), folder / name)[1]


def pixels(seed: int = 0, height: int = SIDE, width: int = SIDE) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


@cache
def clip() -> Clip:
    """Three frames of noise, as a clip that masks, points and cameras belong to."""
    return load_clip([pixels(seed) for seed in range(3)], size=SIDE)


def picture(folder: Path, *, name: str) -> Path:
    Image.fromarray(pixels()).save(folder / name)
    return folder / name


def video(folder: Path, *, suffix: str) -> Path:
    """Write five frames of a video."""
    codec = _CODECS[suffix]
    pictures = (pixels(number, 48, 64) for number in range(5))
    return encode(folder / f"video{suffix}", pictures, codec, "rgb8" if codec == "gif" else "yuv420p")


def _pictures(folder: Path) -> None:
    folder.mkdir()
    for number, suffix in enumerate(("png", "jpg", "webp")):
        Image.fromarray(pixels(number)).save(folder / f"{number}.{suffix}")


def _masks(folder: Path) -> None:
    for number in range(3):
        white = 255 * (pixels(number)[..., 0] > 99)
        write(folder / f"{number:06d}.png", png(white.astype(np.uint8)))


def _frames(path: Path) -> None:
    for _ in open_source(path).frames(Sampling(max_frames=5)):
        pass


def _manifest(folder: Path, *, name: str) -> Path:
    """Write a list of two clips beside their folders."""
    for clip_name in ("a", "b"):
        write(folder / clip_name / "0.png", png(pixels()))
    rows = [{"source": "a", "name": "first"}, {"source": "b", "name": "second"}]
    if name.endswith(".parquet"):
        pq.write_table(pa.Table.from_pylist(rows), folder / name)
        return folder / name
    lines = map(json.dumps, rows) if name.endswith(".jsonl") else ["source,name", "a,first", "b,second"]
    return write(folder / name, "\n".join(lines))


def _clips(path: Path) -> None:
    for source in clips_by_name([str(path)]).values():
        open_source(source)


def _exr(folder: Path) -> Path:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"R": np.ones((8, 12), np.float32)}).write(str(folder / "depth.exr"))
    return folder / "depth.exr"


def _written(folder: Path, *, writer: Callable[..., Path]) -> Path:
    return writer(folder / "capture", folders.make_truth())


def _zipped(folder: Path) -> Path:
    written = _written(folder, writer=folders.record3d)
    path = folders.zipped(written, folder / "capture.r3d")
    shutil.rmtree(written)
    return path


def _read_capture(path: Path) -> None:
    capture = read_capture(path)
    for frame in range(min(2, len(capture))):
        capture.depth(frame)
    if capture.frame_names:
        _frames(path)


def _sequences(path: Path, *, name: str, **options: Any) -> None:
    for open_sequence in find_sequences(name, path, **options).values():
        sequence = open_sequence()
        for read in (sequence.depth, sequence.mask):
            if read is not None:
                read(0)
        read_image(sequence.pictures[0])


def _tum(folder: Path, *, frames: float) -> None:
    tum_folder(folder, np.arange(frames))
    write(folder / "calibration.txt", "5 5 2 1.5")


def _data_set(name: str, function: Callable[[Path], object], folder: str = "set", **options: Any) -> Reader:
    title = " ".join((f"data set {name}", *options.values()))
    return Reader(title, made(function, folder), partial(_sequences, name=name, **options))


def _capture(title: str, writer: Callable[..., Path]) -> Reader:
    return Reader(f"capture {title}", partial(_written, writer=writer), _read_capture)


ROWS = (
    *(Reader(f"picture {end}", partial(picture, name=f"a{end}"), read_image, most) for end, most in _PICTURES.items()),
    *(Reader(f"video {end}", partial(video, suffix=end), _frames, _VIDEO) for end in _CODECS),
    Reader("folder of pictures", made(_pictures), _frames),
    Reader("masks", made(_masks, "masks"), lambda path: load_masks(path, clip())),
    *(
        Reader(f"list of clips {end}", partial(_manifest, name=f"clips{end}"), _clips)
        for end in (".csv", ".jsonl", ".parquet")
    ),
    Reader("points", file("points.csv", "x,y,frame\n3,4,0\n5.5,6,1\n"), lambda path: parse_queries(str(path), clip())),
    Reader(
        "depths", file("depths.csv", "frame,x,y,depth\n0,3,4,2.5\n1,5,6,3\n"), lambda path: read_depths(path, clip())
    ),
    Reader(
        "poses", file("poses.txt", _POSES), lambda path: checked_known_poses(read_poses(path, clip()), 3, str(path))
    ),
    Reader(
        "intrinsics",
        file("K.txt", "30 30 14 14\n"),
        lambda path: at_clip_pixels(read_intrinsics(str(path)), clip(), "intrinsics"),
    ),
    Reader("depth .png", file("depth.png", depth_png([[1000, 0, 2000]] * 4)), lambda path: read_png(path, 1000.0)),
    Reader("depth .dpt", file("depth.dpt", dpt(np.ones((6, 8)))), read_dpt),
    Reader("depth .npy", file("depth.npy", npy(np.ones((6, 8, 1), np.float32))), read_npy),
    Reader("depth .exr", _exr, read_exr),
    _capture("Record3D", folders.record3d),
    Reader("capture .r3d", _zipped, _read_capture),
    _capture("Record3D export", folders.record3d_export),
    _capture("Polycam", folders.polycam),
    _capture("nerfstudio", folders.nerfstudio),
    _capture("COLMAP", folders.colmap_text),
    _capture("COLMAP, binary", partial(folders.colmap_text, form=".bin")),
    _capture("TUM", folders.tum),
    _data_set("plain", plain_folder),
    _data_set("tum", partial(_tum, frames=4.0)),
    _data_set("bonn", partial(_tum, frames=33.0), "rgbd_bonn_x"),  # of which 30 are left out
    _data_set("dycheck", partial(dycheck_folder, frames=3)),
    _data_set("dycheck", partial(dycheck_folder, frames=3), gt="lidar"),
    _data_set("sintel", sintel_folder),
    _data_set("kitti", lambda folder: kitti_folder(folder, range(3), range(3))),
    _data_set("davis", lambda folder: davis_folder(folder, "bear")),
    _data_set("7scenes", lambda folder: scene_folder(folder / "seq-01")),
    *(
        Reader(
            f"result of {name}",
            made(writer, "theirs"),
            partial(Reconstruction.load, format=name, quaternion=QUATERNIONS[name]),
        )
        for name, writer in WRITERS.items()
    ),
)

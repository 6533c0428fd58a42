"""Files of data sets written byte by byte, each by the document that its comment names."""

import json
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from vggtjax.cameras import world_from_camera
from vggtjax.clips.media.sampling import Sampling
from vggtjax.clips.truth import Truth
from vggtjax.research.evaluation.datasets import find_sequences

SINTEL_TAG = struct.pack("<f", 202021.25)

QUARTER_ABOUT_Y = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]  # a turn by 90 degrees


def opened(name: str, root: Path, *, stride: int | None = None, max_frames: int | None = None, **options: Any) -> Any:
    """Open all sequences, of no type: a test knows which ground truth there is."""
    sampling = Sampling(stride=stride, max_frames=max_frames)
    return [opener() for opener in find_sequences(name, root, sampling=sampling, **options).values()]


def write_plain(folder: Path, clip: Truth, *, first: int = 0) -> None:
    """Write a clip with its truth in the plain layout, its frames numbered from `first`; depth in millimetres."""
    for name in ("rgb", "depth", "mask"):
        (folder / name).mkdir(parents=True)
    for i, (image, depth, mask) in enumerate(zip(clip.images, clip.depth, clip.dynamic_mask, strict=True), first):
        Image.fromarray(np.rint(255 * image).astype(np.uint8)).save(folder / f"rgb/{i:05d}.png")
        Image.fromarray(np.rint(1000 * depth).astype(np.uint16)).save(folder / f"depth/{i:05d}.png")
        Image.fromarray(mask.astype(np.uint8) * 255).save(folder / f"mask/{i:05d}.png")
    poses = world_from_camera(np.asarray(clip.camera_from_world))
    np.savetxt(folder / "K.txt", clip.intrinsics[0])
    np.savetxt(folder / "world_from_camera.txt", poses.reshape(-1, 16))


def write(path: Path, content: bytes | str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def png(pixels, palette=None) -> bytes:
    """A PNG (W3C, Portable Network Graphics, 3rd edition): grey of 8 or 16 bits, palette, RGB or RGBA; filter 0."""
    pixels = np.asarray(pixels)
    kind = 3 if palette is not None else {2: 0, 3: {3: 2, 4: 6}.get(pixels.shape[-1], 0)}[pixels.ndim]
    height, width = pixels.shape[:2]
    rows = pixels.astype(">u2" if pixels.dtype == np.uint16 else np.uint8)
    header = struct.pack(">IIBBBBB", width, height, 8 * rows.dtype.itemsize, kind, 0, 0, 0)
    data = zlib.compress(b"".join(b"\0" + row.tobytes() for row in rows))
    chunks = [(b"IHDR", header), (b"IDAT", data), (b"IEND", b"")]
    if palette is not None:
        chunks.insert(1, (b"PLTE", bytes(palette)))
    return b"\x89PNG\r\n\x1a\n" + b"".join(png_chunk(name, body) for name, body in chunks)


def png_chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def picture(height=3, width=4) -> bytes:
    return png(np.full((height, width, 3), 90, np.uint8))


def depth_png(values) -> bytes:
    return png(np.asarray(values, np.uint16))


def dpt(values) -> bytes:
    """MPI Sintel depth training data, `sintel_io.py` (depth_write): tag, width, height, rows of float32."""
    values = np.asarray(values, "<f4")
    return SINTEL_TAG + struct.pack("<ii", values.shape[1], values.shape[0]) + values.tobytes()


def cam(intrinsics, camera_from_world) -> bytes:
    """MPI Sintel depth training data, `sintel_io.py` (cam_write): tag, M as 9 float64, N as 12 float64, x = M N X."""
    return SINTEL_TAG + np.asarray(intrinsics, "<f8").tobytes() + np.asarray(camera_from_world, "<f8").tobytes()


def npy(values) -> bytes:
    """NEP 1, A Simple File Format for NumPy Arrays, version 1.0: magic, length of the header, header, values."""
    values = np.ascontiguousarray(values)
    header = f"{{'descr': '{values.dtype.str}', 'fortran_order': False, 'shape': {values.shape}, }}"
    header += " " * (63 - (len(header) + 10) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + values.tobytes()


def cameras_bin(cameras) -> bytes:
    """COLMAP's `Reconstruction::WriteCamerasBinary`: count, then number, model, width, height, parameters."""
    records = (
        struct.pack("<iiQQ", number, model, width, height) + struct.pack(f"<{len(values)}d", *values)
        for number, model, width, height, values in cameras
    )
    return struct.pack("<Q", len(cameras)) + b"".join(records)


def images_bin(images, points=2) -> bytes:
    """COLMAP's `Reconstruction::WriteImagesBinary`: count, then number, quaternion (w first), translation, camera,
    name that ends with 0, count of points and for each x, y and the number of the 3-D point."""
    records = (
        struct.pack("<i7di", number, *quaternion, *translation, camera)
        + name.encode()
        + b"\0"
        + struct.pack("<Q", points)
        + struct.pack("<ddq", 1.5, 2.5, -1) * points
        for number, quaternion, translation, camera, name in images
    )
    return struct.pack("<Q", len(images)) + b"".join(records)


def camera_json(**changes) -> str:
    """A camera as in demo/datasets/iphone/paper-windmill/camera of github.com/KAIR-BAIR/dycheck: camera-from-world
    rotation (here a quarter turn about y), centre, and pixels of a picture of 4 x 3."""
    fields = {
        "focal_length": 8.0,
        "image_size": [4, 3],
        "orientation": [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]],
        "pixel_aspect_ratio": 1.25,
        "position": [1.0, 2.0, 3.0],
        "principal_point": [2.25, 1.75],
        "radial_distortion": [0.0, 0.0, 0.0],
        "skew": 0.5,
        "tangential_distortion": [0.0, 0.0],
    }
    return json.dumps(fields | changes)

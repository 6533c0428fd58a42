"""Captures as the apps write them, made of a few points seen by known cameras.

Every picture is black with a white square around each point, so that a reader that takes a wrong axis, a wrong pixel
origin or a wrong picture no longer projects the points onto the squares.
"""

import json
import struct
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.shared.dataset_files import cameras_bin, images_bin

FRAMES, WIDTH, HEIGHT = 4, 96, 72


class Truth(NamedTuple):
    points: np.ndarray  # [N, 3]
    intrinsics: np.ndarray  # [S, 3, 3], the centre of the first pixel at (0.5, 0.5)
    world_from_camera: np.ndarray  # [S, 4, 4], OpenCV
    pixels: np.ndarray  # [S, N, 2]
    depth: np.ndarray  # [S, N]


def make_truth(shared: bool = False) -> Truth:
    """Points 2 to 3 away, in middles of 2 x 2 pixels of frame 0; `shared` cameras all have the same intrinsics."""
    rng = np.random.default_rng(5)
    points = np.array([[-0.5, -0.4, 2.0], [0.5, -0.3, 2.5], [0.0, 0.1, 3.0], [-0.4, 0.5, 2.2], [0.6, 0.4, 2.8]])
    intrinsics, poses, pixels, depths = [], [], [], []
    for frame in range(FRAMES):
        change = 0 if shared else frame
        K = np.array([[80.0 + change, 0, 50.0 - change], [0, 78.0 - change, 33.0 + change], [0, 0, 1]])
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(rng.uniform(-0.08, 0.08, 3)).as_matrix()
        pose[:3, 3] = rng.uniform(-0.15, 0.15, 3)
        inside = (points - pose[:3, 3]) @ pose[:3, :3]  # R^T (x - c)
        image = inside @ K.T
        intrinsics.append(K)
        poses.append(pose)
        pixels.append(image[:, :2] / image[:, 2:])
        depths.append(inside[:, 2])
    return Truth(points, *map(np.stack, (intrinsics, poses, pixels, depths)))


def draw(truth: Truth, frame: int, path: Path) -> None:
    """Write the picture of a frame."""
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    for column, row in np.floor(truth.pixels[frame]).astype(int):
        picture[row - 1 : row + 2, column - 1 : column + 2] = 255
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(path, quality=100, subsampling=0)


def depth_map(truth: Truth, frame: int, smaller: int = 1) -> np.ndarray:
    """Depth around the points, 0 elsewhere, with pixels `smaller` times as large as those of the picture."""
    depth = np.zeros((HEIGHT // smaller, WIDTH // smaller), np.float32)
    for (column, row), z in zip(np.floor(truth.pixels[frame] / smaller).astype(int), truth.depth[frame], strict=True):
        depth[row, column] = z
    return depth


def arkit(truth: Truth, frame: int) -> np.ndarray:
    """World-from-camera with the camera's axes right, up, backward: three columns and the centre."""
    right, down, forward, centre = truth.world_from_camera[frame].T[:, :3]
    return np.column_stack([right, -down, -forward, centre])


def write_json(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


def record3d(folder: Path, truth: Truth, **changes: Any) -> Path:
    """The unpacked folder; depth needs lzfse. https://github.com/marek-simonik/record3d/issues/93"""
    import lzfse

    poses = []
    for frame in range(FRAMES):
        draw(truth, frame, folder / f"rgbd/{frame}.jpg")
        pose = arkit(truth, frame)
        poses.append([*Rotation.from_matrix(pose[:, :3]).as_quat().tolist(), *pose[:, 3].tolist()])
        depth = depth_map(truth, frame, smaller=2)
        sure = np.where(depth > 2.75, 0, 2).astype(np.uint8)  # far points are not sure
        (folder / f"rgbd/{frame}.depth").write_bytes(lzfse.compress(depth.tobytes()))
        (folder / f"rgbd/{frame}.conf").write_bytes(lzfse.compress(sure.tobytes()))
    K = truth.intrinsics
    fields = {"w": WIDTH, "h": HEIGHT, "dw": WIDTH // 2, "dh": HEIGHT // 2, "fps": 30, "K": K[0].T.ravel().tolist()}
    coefficients = [[k[0, 0], k[1, 1], k[0, 2], k[1, 2]] for k in K]
    fields |= {"poses": poses, "perFrameIntrinsicCoeffs": coefficients, "initPose": [0, 0, 0, 1, 0, 0, 0]}
    fields |= {"frameTimestamps": [7.0 + frame / 30 for frame in range(FRAMES)]}
    write_json(folder / "metadata", {k: v for k, v in (fields | changes).items() if v is not None})
    return folder


def record3d_export(folder: Path, truth: Truth) -> Path:
    """The export "EXR + JPG" of https://docs.nerf.studio/quickstart/custom_dataset.html, of the unpacked one."""
    import OpenEXR

    record3d(folder, truth)
    (folder / "metadata").rename(folder / "metadata.json")
    (folder / "rgbd").rename(folder / "rgb")
    (folder / "depth").mkdir()
    for frame in range(FRAMES):
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"R": depth_map(truth, frame, smaller=2)}).write(str(folder / f"depth/{frame}.exr"))
    return folder


def zipped(folder: Path, path: Path, **more: bytes) -> Path:
    """The folder as one file, with a sound and a thumbnail beside, as the app writes it."""
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted(folder.rglob("*")):
            if file.is_file():
                archive.write(file, file.relative_to(folder).as_posix())
        for name, data in {"icon": b"jpg", "sound.m4a": b"aac", **more}.items():
            archive.writestr(name, data)
    return path


def polycam(folder: Path, truth: Truth, corrected: bool = True) -> Path:
    """https://github.com/PolyCam/polyform: pictures of ARKit, and those that Polycam corrected."""
    prefix = "corrected_" if corrected else ""
    for frame in range(FRAMES):
        name = f"{638443502000 + 100_000 * frame}"
        draw(truth, frame, folder / f"keyframes/{prefix}images/{name}.jpg")
        if corrected:
            (folder / "keyframes/images").mkdir(exist_ok=True)
            Image.new("RGB", (WIDTH, HEIGHT)).save(folder / f"keyframes/images/{name}.jpg")
        K, pose = truth.intrinsics[frame], arkit(truth, frame)
        camera = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "width": WIDTH, "height": HEIGHT}
        camera |= {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
        camera |= {"blur_score": 115.28, "timestamp": int(name), "manual_keyframe": False}
        write_json(folder / f"keyframes/{prefix}cameras/{name}.json", camera)
        depth = depth_map(truth, frame, smaller=2)
        sure = np.where(depth > 2.75, 0, 127).astype(np.uint8)
        for kind, values in (("depth", (depth * 1000).round().astype(np.uint16)), ("confidence", sure)):
            (folder / f"keyframes/{kind}").mkdir(exist_ok=True)
            Image.fromarray(values).save(folder / f"keyframes/{kind}/{name}.png")
    write_json(folder / "mesh_info.json", {"faceCount": 0})
    return folder


def nerfstudio(folder: Path, truth: Truth, *, top: dict | None = None, frame_fields: dict | None = None) -> Path:
    """https://docs.nerf.studio/quickstart/data_conventions.html, frames in no order."""
    frames = []
    for frame in range(FRAMES):
        draw(truth, frame, folder / f"images/frame_{8 + frame}.png")  # natural order: 8 9 10 11
        K = truth.intrinsics[frame]
        depth = (depth_map(truth, frame) * 1000).astype(np.float32)
        (folder / "depth").mkdir(exist_ok=True)
        if frame % 2:
            np.save(folder / f"depth/{frame}.npy", depth)
        else:
            Image.fromarray(depth.round().astype(np.uint16)).save(folder / f"depth/{frame}.png")
        entry = {"file_path": f"./images/frame_{8 + frame}.png", "w": WIDTH, "h": HEIGHT}
        entry |= {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
        entry |= {"depth_file_path": f"depth/{frame}.{'npy' if frame % 2 else 'png'}"}
        entry |= {"transform_matrix": [*arkit(truth, frame).tolist(), [0.0, 0.0, 0.0, 1.0]]}
        frames.append({k: v for k, v in (entry | (frame_fields or {})).items() if v is not None})
    write_json(folder / "transforms.json", {"camera_model": "OPENCV", **(top or {}), "frames": frames[::-1]})
    return folder


def write_colmap(
    model: Path, truth: Truth, frames: Iterable[int] = range(FRAMES), points: int = 0, form: str = ".txt"
) -> None:
    """Write a model of some of the frames: https://colmap.github.io/format.html, with an image without points."""
    cameras, images = [], []
    for frame in frames:
        K, rotation = truth.intrinsics[frame], truth.world_from_camera[frame, :3, :3].T
        cameras.append((frame + 1, 1, WIDTH, HEIGHT, [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]))
        quaternion = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
        centre = truth.world_from_camera[frame, :3, 3]
        images.append((40 - frame, quaternion, -rotation @ centre, frame + 1, f"view_{8 + frame}.png"))
    model.mkdir(parents=True, exist_ok=True)
    if form == ".bin":
        contents = {"cameras": cameras_bin(cameras), "images": images_bin(images)}
        contents["points3D"] = struct.pack("<Q", points)
    else:
        rows = [f"{number} PINHOLE {w} {h} {' '.join(map(str, values))}" for number, _, w, h, values in cameras]
        lines = ["# Image list", "#   IMAGE_ID, QW, ..."]
        for number, quaternion, place, camera, name in images:
            lines.append(f"{number} {' '.join(map(str, (*quaternion, *place)))} {camera} {name}")
            lines.append("" if camera == 2 else "1.5 2.5 -1 3.5 4.5 7")
        texts = {"cameras": ["# Camera list", "", *rows], "images": lines, "points3D": ["1 0 0 1 9 9 9 -1"] * points}
        contents = {name: ("\n".join(text) + "\n").encode() for name, text in texts.items()}
    for name, content in contents.items():
        (model / f"{name}{form}").write_bytes(content)


def colmap_text(folder: Path, truth: Truth, model: str = "sparse/0", form: str = ".txt") -> Path:
    for frame in range(FRAMES):
        draw(truth, frame, folder / f"images/view_{8 + frame}.png")
    write_colmap(folder / model, truth, form=form)
    return folder


def tum(folder: Path, truth: Truth) -> Path:
    """https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats: pixels count from the centre of the first."""
    lists = {"rgb": ["# color images"], "depth": ["# depth maps"]}
    poses = ["# timestamp tx ty tz qx qy qz qw"]
    for frame in range(FRAMES):
        time = 100 + frame / 10
        draw(truth, frame, folder / f"rgb/{time:.6f}.png")
        (folder / "depth").mkdir(exist_ok=True)
        depth = (depth_map(truth, frame) * 5000).round().astype(np.uint16)
        Image.fromarray(depth).save(folder / f"depth/{time + 0.01:.6f}.png")
        lists["rgb"].append(f"{time:.6f} rgb/{time:.6f}.png")
        lists["depth"].append(f"{time + 0.01:.6f} depth/{time + 0.01:.6f}.png")
        pose = truth.world_from_camera[frame]
        row = [time + 0.005, *pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        poses.append(" ".join(f"{value:.9f}" for value in row))
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(lines))
    (folder / "groundtruth.txt").write_text("\n".join(poses))
    K = truth.intrinsics[0]
    (folder / "calibration.txt").write_text(f"{K[0, 0]} {K[1, 1]} {K[0, 2] - 0.5} {K[1, 2] - 0.5}")
    return folder

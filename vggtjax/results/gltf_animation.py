"""What plays in a glTF file: the camera that filmed the clip, and any other curves over its times."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from vggtjax.results.frame import PLAIN_RATE
from vggtjax.results.result import Result
from vggtjax.results.shown import middle_and_radius

TO_GLTF = np.array([1, -1, -1], np.float32)  # half a turn about x: y down and z forward become y up and z backward
CAMERA_NAME = "camera"  # of the node
_FLOAT = 5126  # glTF's names
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_POINTER = "KHR_animation_pointer"
_NEAR = 1e-3  # of the distance of the scene


def frame_times(result: Result) -> Float64[np.ndarray, " S+1"]:
    """Return when each frame is shown, in seconds from the first, and when the last one ends.

    Frames of clips without times are a tenth of a second apart; frames whose times do not all grow, their median step.
    """
    count = len(result.depth)
    steps = np.zeros(0) if result.timestamps is None else np.diff(result.timestamps)
    if result.timestamps is None or not steps.size or not (steps > 0).all():
        step = float(np.median(steps)) if steps.size else 0.0
        return np.arange(count + 1) * (step if step > 0 else 1 / PLAIN_RATE)
    times = result.timestamps - result.timestamps[0]
    return np.append(times, times[-1] + np.median(np.diff(times)))


def frame_rate(result: Result) -> float:
    """Return frames a second: one over the median step of `frame_times`."""
    return 1 / float(np.median(np.diff(frame_times(result))))


def add_camera(result: Result, buffers: dict[str, bytes], tree: dict[str, Any]) -> None:
    """Add the node `camera`, which has the pose and the field of view of each frame at its time.

    Between frames positions are linear and rotations spherical. glTF's cameras have no principal point: it is taken to
    be the middle. The camera itself has the median field of view; those of the frames are in the extension
    KHR_animation_pointer, which programs that do not know it leave out.

    Args:
        result: of the clip.
        buffers: of the file, as trimesh hands them to a `buffer_postprocessor`; the curves are added.
        tree: of the file; node, camera and animation are added.
    """
    poses = result.world_from_camera.astype(np.float64)
    positions = poses[:, :3, 3] * TO_GLTF
    turns = Rotation.from_matrix(TO_GLTF[:, None] * poses[:, :3, :3] * TO_GLTF).as_quat()  # x, y, z, w as in glTF
    turns[1:][np.logical_xor.accumulate((turns[1:] * turns[:-1]).sum(axis=1) < 0)] *= -1  # q and -q are one turn
    height, width = result.depth.shape[1:]
    focal = result.intrinsics[:, [0, 1], [0, 1]].astype(np.float64)
    fields = 2 * np.arctan(height / 2 / focal[:, 1])
    lens = {
        "yfov": float(np.median(fields)),
        "aspectRatio": float(np.median(focal[:, 1] * width / (focal[:, 0] * height))),
        "znear": _NEAR * middle_and_radius(result)[1],
    }
    number = len(tree["nodes"])
    tree["cameras"] = [{"name": CAMERA_NAME, "type": "perspective", "perspective": lens}]
    node = {"name": CAMERA_NAME, "camera": 0, "translation": positions[0].tolist(), "rotation": turns[0].tolist()}
    tree["nodes"].append(node)
    tree["scenes"][tree["scene"]]["nodes"].append(number)
    times = frame_times(result)[:-1]
    if len(times) < 2:
        return
    animate(buffers, tree, {"node": number, "path": "translation"}, times, positions)
    animate(buffers, tree, {"node": number, "path": "rotation"}, times, turns)
    pointer = {"extensions": {_POINTER: {"pointer": "/cameras/0/perspective/yfov"}}, "path": "pointer"}
    animate(buffers, tree, pointer, times, fields)
    tree["extensionsUsed"] = sorted({*tree.get("extensionsUsed", ()), _POINTER})


def animate(
    buffers: dict[str, bytes],
    tree: dict[str, Any],
    target: dict[str, Any],
    times: np.ndarray,
    values: np.ndarray,
    interpolation: Literal["LINEAR", "STEP"] = "LINEAR",
) -> None:
    """Add a curve to the one animation of a file: values [T] or [T, 3 or 4] of a target at times [T] in seconds."""
    (animation,) = tree.setdefault("animations", [{"name": "frames", "samplers": [], "channels": []}])
    animation["channels"].append({"sampler": len(animation["samplers"]), "target": target})
    curve = {"input": _accessor(buffers, tree, times), "output": _accessor(buffers, tree, values)}
    animation["samplers"].append(curve | {"interpolation": interpolation})


def _accessor(buffers: dict[str, bytes], tree: dict[str, Any], values: np.ndarray) -> int:
    """Add float32 values to the file; return the number of their accessor."""
    data = np.ascontiguousarray(values, np.float32).reshape(len(values), -1)
    number = len(tree["accessors"])
    name = f"animation_{number}"
    buffers[name] = data.tobytes()
    accessor = {"bufferView": len(buffers) - 1, "componentType": _FLOAT, "count": len(data)}
    accessor |= {"type": _KINDS[data.shape[1]], "min": data.min(axis=0).tolist(), "max": data.max(axis=0).tolist()}
    tree["accessors"][name] = accessor  # trimesh makes a list of the values
    return number

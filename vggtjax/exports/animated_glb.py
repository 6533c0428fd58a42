"""A GLB with an animation: the moving points of each frame are shown in turn, over the static ones."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from vggtjax.results.glb import build_scene, glb_bytes
from vggtjax.results.point_cloud import PointCloud
from vggtjax.results.result import Result

_FRAMES_A_SECOND = 10.0  # of clips without times
_FLOAT, _SCALAR, _VEC3 = 5126, "SCALAR", "VEC3"  # glTF's names


def write_animated_glb(path: Path, result: Result, static: PointCloud, moving: Sequence[PointCloud]) -> None:
    """Write the scene of `build_scene` with one animation, which a viewer loops.

    glTF animates no visibility, so a frame's node has the scale 1 while it is due and 0 otherwise, in steps.
    """
    times = frame_times(result)

    def animate(buffers: dict[str, bytes], tree: dict[str, Any]) -> None:
        nodes = {node.get("name"): number for number, node in enumerate(tree["nodes"])}
        samplers, channels = [], []
        for frame in range(len(result.depth)):
            node = nodes.get(f"dynamic_{frame:06d}")
            if node is None:
                continue
            keys, scales = _steps(times, frame)
            inputs = _accessor(tree, buffers, keys, _SCALAR)
            outputs = _accessor(tree, buffers, np.repeat(scales[:, None], 3, axis=1), _VEC3)
            channels.append({"sampler": len(samplers), "target": {"node": node, "path": "scale"}})
            samplers.append({"input": inputs, "output": outputs, "interpolation": "STEP"})
            tree["nodes"][node].pop("matrix", None)  # an animated node has no matrix; these nodes are not placed
        if channels:
            tree["animations"] = [{"name": "frames", "samplers": samplers, "channels": channels}]

    path.write_bytes(glb_bytes(build_scene(result, static, moving), animate))


def frame_times(result: Result) -> Float64[np.ndarray, " S+1"]:
    """Return when each frame is shown, in seconds from the first, and when the last one ends."""
    count = len(result.depth)
    if result.timestamps is None or count < 2 or not (np.diff(result.timestamps) > 0).all():
        return np.arange(count + 1) / _FRAMES_A_SECOND
    times = result.timestamps - result.timestamps[0]
    return np.append(times, times[-1] + np.median(np.diff(times)))


def _steps(times: Float64[np.ndarray, " S+1"], frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the times and scales of a frame's node: 0, 1 from its time on, 0 from the next frame's, until the end."""
    last = len(times) - 2
    keys = sorted({0.0, times[frame], times[min(frame + 1, last)], times[-1]})
    shown = [float(times[frame] <= key and (key < times[frame + 1] or frame == last)) for key in keys]
    return np.array(keys, np.float32), np.array(shown, np.float32)


def _accessor(tree: dict[str, Any], buffers: dict[str, bytes], values: np.ndarray, kind: str) -> int:
    """Add float32 values to the file; return the number of their accessor."""
    data = np.ascontiguousarray(values, np.float32)
    number = len(tree["accessors"])
    buffers[f"animation_{number}"] = data.tobytes()
    accessor = {"bufferView": len(buffers) - 1, "componentType": _FLOAT, "count": len(data), "type": kind}
    lowest, highest = data.min(axis=0), data.max(axis=0)
    accessor |= {"min": np.atleast_1d(lowest).tolist(), "max": np.atleast_1d(highest).tolist()}
    tree["accessors"][f"animation_{number}"] = accessor  # trimesh makes a list of the values
    return number

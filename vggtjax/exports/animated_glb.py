"""A GLB with an animation: the moving points of each frame are shown in turn, over the static ones."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from vggtjax.results.glb import build_scene, limited_clouds
from vggtjax.results.point_cloud import PointCloud
from vggtjax.results.result import Result

_FRAMES_A_SECOND = 10.0  # of clips without times


def write_animated_glb(path: Path, result: Result, static: PointCloud, moving: Sequence[PointCloud]) -> None:
    """Write the scene of `build_scene` with one animation, which a viewer loops.

    glTF animates no visibility, so a frame's node has the scale 1 while it is due and 0 otherwise, in steps.
    """
    times = frame_times(result)

    glb = build_scene(result, limited_clouds(static, moving))
    nodes = {node["name"]: number for number, node in enumerate(glb.tree["nodes"])}
    samplers, channels = [], []
    for frame in range(len(result.depth)):
        node = nodes.get(f"dynamic_{frame:06d}")
        if node is None:
            continue
        keys, scales = _steps(times, frame)
        inputs, outputs = (glb.array(values, bounds=True) for values in (keys, np.repeat(scales[:, None], 3, axis=1)))
        channels.append({"sampler": len(samplers), "target": {"node": node, "path": "scale"}})
        samplers.append({"input": inputs, "output": outputs, "interpolation": "STEP"})
    if channels:
        glb.tree["animations"] = [{"name": "frames", "samplers": samplers, "channels": channels}]
    glb.write(path)


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

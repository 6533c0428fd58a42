"""A GLB with an animation: the moving points of each frame are shown in turn, over the static ones, by its camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from vggtjax.results.glb import build_scene, glb_bytes
from vggtjax.results.gltf_animation import add_camera, animate, frame_times
from vggtjax.results.point_cloud import PointCloud
from vggtjax.results.result import Result


def write_animated_glb(path: Path, result: Result, static: PointCloud, moving: Sequence[PointCloud]) -> None:
    """Write the scene of `build_scene` with its camera and one animation, which a viewer loops.

    glTF animates no visibility, so a frame's node has the scale 1 while it is due and 0 otherwise, in steps.
    """
    times = frame_times(result)

    def edit(buffers: dict[str, bytes], tree: dict[str, Any]) -> None:
        nodes = {node.get("name"): number for number, node in enumerate(tree["nodes"])}
        for frame in range(len(result.depth)):
            node = nodes.get(f"dynamic_{frame:06d}")
            if node is None:
                continue
            keys, scales = _steps(times, frame)
            scales = np.repeat(scales[:, None], 3, axis=1)
            animate(buffers, tree, {"node": node, "path": "scale"}, keys, scales, "STEP")
            tree["nodes"][node].pop("matrix", None)  # an animated node has no matrix; these nodes are not placed
        add_camera(result, buffers, tree)

    path.write_bytes(glb_bytes(build_scene(result, static, moving), edit))


def _steps(times: Float64[np.ndarray, " S+1"], frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the times and scales of a frame's node: 0, 1 from its time on, 0 from the next frame's, until the end."""
    last = len(times) - 2
    keys = sorted({0.0, times[frame], times[min(frame + 1, last)], times[-1]})
    shown = [float(times[frame] <= key and (key < times[frame + 1] or frame == last)) for key in keys]
    return np.array(keys, np.float32), np.array(shown, np.float32)

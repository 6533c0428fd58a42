"""A result as a .viser file: a recording that viser's own player shows. Needs the extra "view"."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from vggtjax.errors import check_extra
from vggtjax.progress import Progress
from vggtjax.results.result import Result
from vggtjax.results.shown import middle_and_radius, shown_points
from vggtjax.storage.writing import writing
from vggtjax.viewer.home import SAME_PLACE, home_view
from vggtjax.viewer.scene import FRUSTUM, Budget, frame_rate, shown_widths


def write_recording(
    path: str | Path, result: Result, *, budget: Budget = Budget(), progress: Progress | None = None
) -> None:
    """Write the static points, the moving points of each frame and the cameras, one frame after the other.

    Raises MissingExtraError without viser, and OutputError.
    """
    check_extra("a .viser file", "view", "viser")
    import viser

    frames, height, width = result.depth.shape
    most_moving = budget.moving // frames
    static, moving = shown_points(result, most_static=budget.static, most_moving=most_moving, progress=progress)
    _, radius = middle_and_radius(result)
    with contextlib.redirect_stdout(io.StringIO()):  # viser says where its server listens
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        try:
            home = {name: np.array(value) for name, value in home_view(result, SAME_PLACE).items()}
            start = server.initial_camera
            start.up, start.position, start.look_at = home["up"], home["eye"], home["target"]
            server.scene.set_up_direction(home["up"])
            recording = server.get_scene_serializer()
            sizes = [
                float(np.median(widths)) if widths.size else 0.0 for widths in shown_widths(result, static, moving)
            ]
            colors = static.values(result.images)
            server.scene.add_point_cloud("/static", static.positions, colors, point_size=sizes[0])
            nodes = []
            for frame, points in enumerate(moving):
                colors, size = points.values(result.images), sizes[1 + frame]
                rotation = Rotation.from_matrix(result.world_from_camera[frame, :3, :3])
                camera = server.scene.add_camera_frustum(
                    f"/frame/{frame:06d}/camera",
                    fov=float(2 * np.arctan(height / 2 / result.intrinsics[frame, 1, 1])),
                    aspect=width / height,
                    scale=FRUSTUM * radius,
                    image=result.images[frame],
                    wxyz=rotation.as_quat(scalar_first=True),
                    position=result.camera_centres[frame],
                    visible=frame == 0,
                )
                name = f"/frame/{frame:06d}/points"
                cloud = server.scene.add_point_cloud(
                    name, points.positions, colors, point_size=size, visible=frame == 0
                )
                nodes.append((camera, cloud))
            for frame, shown in enumerate(nodes):
                for node in nodes[frame - 1] if frame else ():
                    node.visible = False
                for node in shown:
                    node.visible = True
                recording.insert_sleep(1 / frame_rate(result))
            written = recording.serialize()
        finally:
            server.stop()
    with writing(path) as temporary:
        temporary.write_bytes(written)

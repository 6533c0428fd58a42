"""A result as a recording of rerun (https://rerun.io), with a time line."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from vggtjax.results.exports.views import View
from vggtjax.results.point_cloud import PointCloud


def write_rerun(path: Path, items: Iterator[View], static: PointCloud, moving: Sequence[PointCloud]) -> None:
    """Write an .rrd: cameras with pictures and depth, static points, and the moving points of the due frame.

    Axes are the result's: x right, y down, z forward. Time lines are "frame" and "time", in seconds.
    """
    import rerun

    recording = rerun.RecordingStream("vggtjax", recording_id="vggtjax", send_properties=False)
    recording.save(path)
    recording.log("world", rerun.ViewCoordinates.RDF, static=True)
    recording.log("world/static", rerun.Points3D(static.points, colors=static.colors), static=True)
    centres = []
    for number, view in enumerate(items):
        height, width = view.size
        rotation, centre = view.world_from_camera[:3, :3], view.world_from_camera[:3, 3]
        centres.append(centre)
        recording.set_time("frame", sequence=number)
        recording.set_time("time", duration=view.time)
        recording.log("world/camera", rerun.Transform3D(translation=centre, mat3x3=rotation))
        recording.log(
            "world/camera/picture", rerun.Pinhole(image_from_camera=view.frame.intrinsics, resolution=[width, height])
        )
        recording.log("world/camera/picture", rerun.Image(view.frame.image).compress(jpeg_quality=90))
        depth = np.where(view.frame.valid, view.frame.depth, 0)
        recording.log("world/camera/picture/depth", rerun.DepthImage(depth, meter=1.0))
        if view.has_mask:
            mask = view.frame.dynamic_mask.astype(np.uint8)
            recording.log("world/camera/picture/moving", rerun.SegmentationImage(mask))
        points = moving[number]
        recording.log("world/moving", rerun.Points3D(points.points, colors=points.colors))
    recording.log("world/path", rerun.LineStrips3D([np.array(centres)]), static=True)
    recording.flush()
    recording.disconnect()

"""What a clip is, before anything is made of it: for `vggtjax info`. Does not import jax."""

from __future__ import annotations

from pathlib import Path

from vggtjax.clips.captures.frames import CaptureFrames
from vggtjax.clips.captures.table import capture_kind
from vggtjax.clips.clip import read_clip
from vggtjax.clips.media.images import ImageFiles, is_image_name
from vggtjax.clips.media.sampling import Sampling
from vggtjax.clips.media.video import VideoFile, is_video_name
from vggtjax.clips.preprocessing import Fitter
from vggtjax.clips.sources import open_source
from vggtjax.pipeline.known.stated import focal_in_words


def is_clip(path: Path) -> bool:
    """Return whether a path names a video, a picture, a capture, or a folder of pictures rather than a model."""
    if path.is_dir():
        return bool(capture_kind(path)) or any(is_image_name(entry) for entry in path.iterdir())
    return path.is_file() and (is_image_name(path) or is_video_name(path) or bool(capture_kind(path)))


def clip_facts(path: str) -> dict[str, str]:
    """Return what a clip is, in words: frames, size, length, focal length, and what a capture has.

    Raises ClipError for what cannot be read, and MissingExtraError as `open_source`.
    """
    source = open_source(path)
    clip = read_clip(source, Sampling(max_frames=1), Fitter())
    height, width = clip.source_size[0].tolist()
    frames, seconds = source.total(Sampling()), source.seconds() if isinstance(source, VideoFile) else None
    facts = {"size": f"{width} x {height} pixels of the first frame, upright"}
    facts |= {} if frames is None else {"frames": str(frames)}
    facts |= {} if seconds is None else {"length": f"{seconds:.2f} s, as the file states it"}
    facts["focal length"] = focal_in_words(clip)
    if isinstance(source, ImageFiles) and source.times is not None:
        facts["times"] = f"from {source.times.origin}"
    if isinstance(source, CaptureFrames):
        capture = source.capture
        known = {
            "intrinsics": capture.intrinsics,
            "poses": capture.world_from_camera,
            "depth": capture.depth_files,
            "times": capture.timestamps,
        }
        facts["capture"] = (
            f"{capture.kind}, with {', '.join(name for name, value in known.items() if value is not None)}"
        )
        facts |= {"lens": f"undistorted ({source.lenses_undone})"} if source.lenses_undone else {}
    return facts

"""What a method makes of a clip -> the fields of a Reconstruction."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vggtjax.cameras import world_from_camera
from vggtjax.clips.captures.frames import CaptureFrames
from vggtjax.clips.clip import Clip
from vggtjax.clips.media.arrays import in_bytes
from vggtjax.clips.media.images import ImageFiles
from vggtjax.clips.queries import Queries
from vggtjax.clips.shots import looks_of
from vggtjax.method.assembly import Assembly, FusionRule
from vggtjax.method.fusion.file import fusion_digest
from vggtjax.method.passes import Passes
from vggtjax.network.aggregator import reference_frame
from vggtjax.network.backbone import Features
from vggtjax.network.checkpoint import Model
from vggtjax.network.heads.track_head import Tracks
from vggtjax.network.model import Predictions
from vggtjax.network.precision import Compute
from vggtjax.options import Options
from vggtjax.pipeline.devices import on_host
from vggtjax.results.report import versions

_MATCHED = "mined: matches between frames and Gram similarities"
_NOT_MATCHED = "mined: Gram similarities, as matches between frames cannot be used"


def assembled_fields(assembly: Assembly, source: Predictions, clip: Clip, *, world_is_first: bool) -> dict[str, Any]:
    """Return a method's depth, confidence and cameras of the first clip; the pass `source` gave the intrinsics.

    Frames of one colour have the lowest confidence of all pixels: nothing in them tells their depth. Unless the world
    already is the first camera's, as far as the network says, it becomes that.
    """
    depth, confidence, camera_from_world, intrinsics = (np.array(x)[0] for x in jax.tree.leaves(assembly))
    if not world_is_first:
        camera_from_world = (camera_from_world @ world_from_camera(camera_from_world[:1])).astype(np.float32)
    blank = [number for number, look in enumerate(looks_of(clip.images, clip.valid_box)) if look.is_blank]
    if blank:
        confidence[blank] = np.nanmin(confidence)
    fields_of_view = np.asarray(source.pose_encoding)[0][:, [8, 7]]  # of width and height
    focal = intrinsics[:, [0, 1], [0, 1]]
    # tan(fov / 2) has period 2 pi: a field of view above pi gets a negative focal length, which Reconstruction clamps.
    intrinsics[:, [0, 1], [0, 1]] = np.where(fields_of_view > np.pi, -np.abs(focal), focal)
    return {
        "depth": depth,
        "depth_confidence": confidence,
        "camera_from_world": camera_from_world,
        "intrinsics": intrinsics,
    }


def motion_by_matches(passes: Passes, mask_source: str) -> tuple[Float[np.ndarray, "S h w"] | None, str]:
    """Return the motion by matches over its median, None where they gave no mask, and the source of the mask."""
    if passes.motion is None or passes.is_matched is None:
        return None, mask_source
    if not passes.is_matched.all():
        return None, _NOT_MATCHED
    return np.asarray(passes.motion[0] / np.median(passes.motion[0])), _MATCHED


def clip_fields(clip: Clip) -> dict[str, Any]:
    """Return the fields of a Reconstruction that the clip gives."""
    names = ("timestamps", "source_size", "source_scale", "source_offset", "valid_box")
    fields: dict[str, Any] = {name: getattr(clip, name) for name in names}
    return {**fields, "images": in_bytes(clip.images), "frame_names": tuple(clip.frame_names)}


def track_fields(queries: Queries, by_frame: dict[int, Tracks], frames: int) -> dict[str, Any]:
    """Return the tracks of all query frames in the order of the queries, as fields of a Reconstruction."""
    Q = len(queries.frames)
    fields = {
        "track_positions": np.zeros((frames, Q, 2), np.float32),
        "track_visibility": np.zeros((frames, Q), np.float32),
        "track_confidence": np.zeros((frames, Q), np.float32),
    }
    for frame, tracks in by_frame.items():
        for values, of_frame in zip(fields.values(), tracks, strict=True):
            values[:, queries.frames == frame] = of_frame[0]
    return fields | {"track_frames": queries.frames}


def settings_of(
    model: Model, clip: Clip, options: Options, mask_source: str, fusion: FusionRule | None
) -> dict[str, Any]:
    """Return the settings that a result depends on besides the method, as JSON values."""
    settings = {name: value for name, value in options.to_json().items() if name != "method"}
    settings |= {"mode": clip.mode, "size": clip.size, "patch": clip.patch}
    settings |= {"masks": mask_source, "consistent_depth": options.consistent_depth, "cues": model.config.motion.digest}
    settings |= {} if fusion is None else {"fusion": fusion_digest(fusion)}
    settings |= {"clip": clip.source.name} if clip.source.name else {}
    if isinstance(clip.source, ImageFiles) and (times := clip.source.times) is not None:
        settings |= {"times": times.origin, "first_time": float(times.first)}
        settings |= {"first_time_exact": str(times.first), "time_digits": times.digits}
    if isinstance(clip.source, CaptureFrames) and clip.source.lenses_undone:
        settings["undistorted"] = clip.source.lenses_undone
    return settings | ({"model_note": model.note} if model.note else {}) | {"versions": versions()}


def reference_setting(features: Features | None, clip: Clip, options: Options) -> dict[str, str]:
    """Return the name of the frame that the network looked at first, as a setting; none of a family with no choice."""
    if features is None or features.class_tokens is None:
        return {}
    tokens = jnp.asarray(on_host(features.class_tokens)[:, : len(clip.images)])
    number = reference_frame(tokens, compute=Compute(reference=options.reference, attention=options.attention))
    return {"reference_frame": clip.frame_names[int(number[0])]}


def kept_passes(passes: Passes) -> Passes:
    """Return passes without what the result has, and without matches that nothing reads any more."""
    return passes._replace(tracks=None, matches=None)

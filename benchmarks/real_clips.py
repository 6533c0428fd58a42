"""Filmed clips with ground truth, in windows: folders in the layout `plain` of vggtjax/research/evaluation/datasets."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from vggtjax.clips.clip import load_clip
from vggtjax.clips.media.sampling import Sampling
from vggtjax.clips.truth import Truth, at_clip_pixels, intrinsics_at_clip_pixels
from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError
from vggtjax.research.evaluation.datasets import find_sequences
from vggtjax.research.evaluation.datasets.sequence import LabelledSequence


class Windows(NamedTuple):
    """Windows of clips, all of one shape: truth [B, S, ...] and the name of each."""

    names: list[str]
    truth: Truth


def load_windows(root: Path, config: VGGTConfig, frames: int) -> Windows:
    """Load every clip at or below a folder in windows of `frames` consecutive frames, fitted to the model.

    The fewest windows that cover each take, spread evenly, so that the last ones overlap where they must. The truth is
    taken to the prediction's pixels without averaging.

    Raises:
        InputError: a take shorter than a window, without depth or cameras, or clips of several sizes.
    """
    names, truths = [], []
    for name, opened in find_sequences("plain", root, sampling=Sampling(stride=1), strict=True).items():
        sequence = opened()
        if len(sequence) < frames:
            raise InputError(f"{name} in {root} has {len(sequence)} frames; choose --frames of at most that")
        for start in window_starts(len(sequence), frames):
            chosen = range(start, start + frames)
            first, last = sequence.frame_names[start], sequence.frame_names[start + frames - 1]
            names.append(f"{name.split()[0]} {first}-{last}")
            truths.append(_window(sequence, config, chosen))
    try:
        return Windows(names, Truth(*(np.stack(arrays) for arrays in zip(*truths, strict=True))))
    except ValueError:
        raise InputError(f"the clips in {root} differ in size") from None


def window_starts(count: int, frames: int) -> list[int]:
    """Return the starts of the fewest windows of `frames` that cover `count` frames, evenly spread."""
    windows = -(-count // frames)
    return np.linspace(0, count - frames, windows).round().astype(int).tolist()


def _window(sequence: LabelledSequence, config: VGGTConfig, chosen: range) -> Truth:
    if sequence.depth is None or sequence.world_from_camera is None or sequence.intrinsics is None:
        raise InputError(f"{sequence.name}: {'; '.join(sequence.notes)}; expected depth/, K.txt and cameras")
    pictures = [str(sequence.pictures[frame]) for frame in chosen]
    clip = load_clip(pictures, size=config.image_size, patch=config.patch_size)
    depth = np.stack([sequence.depth(frame) for frame in chosen])
    masks = [None if sequence.mask is None else sequence.mask(frame) for frame in chosen]
    known = [each for each in masks if each is not None]
    if sequence.mask is not None and len(known) < len(masks):
        raise InputError(f"{sequence.name} has {len(known)} masks for {len(masks)} frames; expected one for each")
    mask = np.stack(known) if known else depth < 0
    return Truth(
        images=clip.images,
        depth=at_clip_pixels(clip, depth),
        dynamic_mask=at_clip_pixels(clip, mask),
        camera_from_world=np.linalg.inv(sequence.world_from_camera[chosen])[:, :3],
        intrinsics=intrinsics_at_clip_pixels(clip, sequence.intrinsics[chosen]),
    )

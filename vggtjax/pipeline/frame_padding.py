"""Lengths that clips are padded to, so that clips of similar length share what is compiled. Does not import jax."""

from __future__ import annotations

_DIGITS = 4  # significant binary ones: no clip gets longer by more than an eighth


def padded_frames(frames: int, offsets: tuple[int, ...]) -> int:
    """Return the next length with four significant binary digits: 1 to 16, 18, 20, ... 32, 36, ...

    A clip in which a frame has no other frame at any of the `offsets` of the motion cues keeps its length.
    """
    if not all(any(0 <= frame + offset < frames for offset in offsets) for frame in range(frames)):
        return frames
    step = 1 << max(frames.bit_length() - _DIGITS, 0)
    return -(-frames // step) * step

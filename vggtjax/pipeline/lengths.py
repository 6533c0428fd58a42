"""Lengths that clips are padded to, so that clips of similar length share compiled programs."""

from __future__ import annotations

_DIGITS = 4  # significant binary digits: no clip gets longer by more than an eighth


def padded_frames(frames: int, offsets: tuple[int, ...]) -> int:
    """Return the length rounded up to four significant binary digits: 1 to 16, 18, 20, ... 32, 36, ...

    Clips of similar length then share compiled programs. A clip is not padded if one of its frames has no other frame
    at any of the `offsets` of the motion cues: padding would give that frame another one to be compared with.
    """
    if not all(any(0 <= frame + offset < frames for offset in offsets) for frame in range(frames)):
        return frames
    step = 1 << max(frames.bit_length() - _DIGITS, 0)
    return -(-frames // step) * step

"""What strangers may ask of the app. Imports neither numpy nor jax: the command line takes its options from here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from vggtjax.storage.json_values import check_fields

LEAST_TOKEN = 16  # characters
_Count = Annotated[int, Meta(ge=1, le=100_000)]


@dataclass(frozen=True)
class Limits:
    """The bounds of a job, of the queue and of the disk. Raises InputError for a number below 1."""

    max_upload_mb: _Count = 500
    """megabytes of the video, or of all pictures together"""
    max_seconds: _Count = 300
    """length of a video"""
    max_frames: _Count = 32
    """frames that are reconstructed of a video or of pictures"""
    max_waiting: _Count = 8
    """jobs that wait for their turn; one runs at a time"""
    max_results: _Count = 8
    """finished results on disk; older ones are removed"""

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def upload_bytes(self) -> int:
        return self.max_upload_mb * 1_000_000

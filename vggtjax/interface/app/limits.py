"""What strangers may ask of the app. Imports neither numpy nor jax: the command line takes its options from here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from vggtjax.storage.json_values import check_fields

_Count = Annotated[int, Meta(ge=1, le=100_000)]


@dataclass(frozen=True)
class Limits:
    """The bounds of a job and of the queue. Raises InputError for a number below 1.

    Attributes:
        max_upload_mb: most megabytes of a video, or of all pictures together
        max_seconds: longest video that is accepted, in seconds
        max_frames: most frames that are reconstructed of a video or of pictures
        max_waiting: most jobs that wait; one runs at a time
    """

    max_upload_mb: _Count = 500
    max_seconds: _Count = 300
    max_frames: _Count = 32
    max_waiting: _Count = 8

    def __post_init__(self) -> None:
        check_fields(self)

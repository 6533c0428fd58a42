"""Arguments that commands share, with their names in help texts. Does not import jax."""

from __future__ import annotations

from typing import Annotated

import tyro

from vggtjax.clips.preprocessing import Framing
from vggtjax.clips.sampling import Sampling
from vggtjax.options import Options
from vggtjax.results.saving import Saving

_SOURCES = tyro.conf.arg(metavar="SOURCE [SOURCE ...]", help_behavior_hint="(required)")

Sources = Annotated[tuple[str, ...], tyro.conf.Positional, _SOURCES]
ModelName = Annotated[str | None, tyro.conf.arg(metavar="MODEL", help_behavior_hint="(required)")]
Frames = Annotated[Sampling, tyro.conf.arg(name="frame")]
Size = Annotated[Framing, tyro.conf.arg(name="size")]
Method = Annotated[Options, tyro.conf.arg(name="method")]
Output = Annotated[Saving, tyro.conf.arg(name="output")]

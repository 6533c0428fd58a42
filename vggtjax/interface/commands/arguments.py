"""Types that several commands take; each command lists them itself. Does not import jax."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from vggtjax.clips.preprocessing import Framing
from vggtjax.interface.commands.flags import InWords, Switch, in_group, option
from vggtjax.options import Options
from vggtjax.storage.trajectories import Quaternion

_SOURCES = tyro.conf.arg(metavar="SOURCE [SOURCE ...]", help_behavior_hint="(required)")

Sources = Annotated[tuple[str, ...], tyro.conf.Positional, _SOURCES]
ResultPath = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULT")]
ModelName = Annotated[str | None, tyro.conf.arg(metavar="MODEL", help_behavior_hint="(required)")]
Size = Annotated[Framing, tyro.conf.arg(name="input", help="")]
Method = Annotated[Options, tyro.conf.arg(name="method", help="")]

_COMMIT = "commit of a hub id, 40 hexadecimal digits; by default the one that was newest at the first use"
Revision = Annotated[str | None, tyro.conf.arg(metavar="COMMIT", help=_COMMIT, help_behavior_hint="")]

_ORDER = (
    "order of the quaternions in pred_traj.txt, required for vggt4d, monst3r, easi3r, das3r and pomato:\n"
    "wxyz as these programs write it, or xyzw; not for other formats"
)
QuaternionOrder = Annotated[Quaternion | None, tyro.conf.arg(help=_ORDER, help_behavior_hint="")]

_REPLACE = "replace the file if it exists; never the source, or a part of a result"
Overwrite = Annotated[tyro.conf.FlagCreatePairsOff[bool], tyro.conf.arg(help=_REPLACE, help_behavior_hint="")]

CONSISTENT = Options(consistent_depth=True)
"""What the commands `reconstruct` and `batch` do unless told otherwise; functions keep to the papers."""


_RESULT = "folder for the result; an earlier result in it is replaced as a whole"
_BATCH = "folder for the results, or a URL such as s3://bucket/results, with one folder per clip, named after it"
_EVALUATION = "folder for results.json, results.csv, table.md, table.tex and index.html"
_VIEW = "open the viewer at the end; vggtjax view has its options"
_SHOTS = (
    "keep a clip with cuts as one clip, or split it: each shot gets a result of its own, in OUT/shot_1 and on,\n"
    "without flashes and frames of one colour"
)
_SHARD = "take every N-th clip, from the K-th on: runs for K from 1 to N do the batch together, in one folder"

ResultFolder = Annotated[Path, in_group("output", option("out", Path, help=_RESULT))]
BatchFolder = Annotated[str, in_group("output", option("out", str, help=_BATCH, metavar="FOLDER|URL"))]
EvaluationFolder = Annotated[Path, in_group("output", option("out", Path, help=_EVALUATION))]
View = Annotated[bool, in_group("output", option("view", Switch, False, help=_VIEW))]
Shots = Annotated[str, in_group("input", option("shots", Literal["keep", "split"], "keep", help=_SHOTS))]
Shards = Annotated[
    str | None, in_group("output", option("shard", InWords[str | None], None, help=_SHARD, metavar="K/N"))
]

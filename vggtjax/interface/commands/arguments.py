"""Types that several commands take; each command lists them itself. Does not import jax."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from vggtjax.clips.preprocessing import Framing
from vggtjax.interface.commands.flags import InWords, Switch
from vggtjax.options import Options

_SOURCES = tyro.conf.arg(metavar="SOURCE [SOURCE ...]", help_behavior_hint="(required)")

Sources = Annotated[tuple[str, ...], tyro.conf.Positional, _SOURCES]
ResultPath = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULT")]
ModelName = Annotated[str | None, tyro.conf.arg(metavar="MODEL", help_behavior_hint="(required)")]
Revision = Annotated[str | None, tyro.conf.arg(metavar="COMMIT", help_behavior_hint="")]
Size = Annotated[Framing, tyro.conf.arg(name="input", help="")]
Method = Annotated[Options, tyro.conf.arg(name="method", help="")]

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


def _result_folder(out: Annotated[Path, tyro.conf.arg(help=_RESULT)]) -> Path:
    return out


def _batch_folder(out: Annotated[str, tyro.conf.arg(help=_BATCH, metavar="FOLDER|URL")]) -> str:
    return out


def _evaluation_folder(out: Annotated[Path, tyro.conf.arg(help=_EVALUATION)]) -> Path:
    return out


def _view(view: Annotated[Switch, tyro.conf.arg(help=_VIEW)] = False) -> bool:
    return view


def _shots(shots: Annotated[Literal["keep", "split"], tyro.conf.arg(help=_SHOTS)] = "keep") -> str:
    return shots


def _shard(shard: Annotated[InWords[str | None], tyro.conf.arg(help=_SHARD, metavar="K/N")] = None) -> str | None:
    return shard


# The name puts a flag into the group of that name.
ResultFolder = Annotated[Path, tyro.conf.arg(constructor=_result_folder, name="output", prefix_name=False, help="")]
BatchFolder = Annotated[str, tyro.conf.arg(constructor=_batch_folder, name="output", prefix_name=False, help="")]
EvaluationFolder = Annotated[
    Path, tyro.conf.arg(constructor=_evaluation_folder, name="output", prefix_name=False, help="")
]
View = Annotated[bool, tyro.conf.arg(constructor=_view, name="output", prefix_name=False, help="")]
Shots = Annotated[str, tyro.conf.arg(constructor=_shots, name="input", prefix_name=False, help="")]
Shards = Annotated[str | None, tyro.conf.arg(constructor=_shard, name="output", prefix_name=False, help="")]

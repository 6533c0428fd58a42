"""The command `vggtjax convert`. Does not import jax before it is needed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from vggtjax.interface.commands.arguments import Overwrite, Revision
from vggtjax.interface.commands.flags import InWords
from vggtjax.interface.commands.models import at_revision, read_config
from vggtjax.interface.commands.report import Report
from vggtjax.storage.writing import check_file


def convert(
    source: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SOURCE")],
    destination: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DESTINATION")],
    /,
    *,
    revision: Revision = None,
    config: InWords[Path | None] = None,
    heads: Annotated[str | None, tyro.conf.arg(metavar="HEAD,HEAD", help_behavior_hint="")] = None,
    dtype: Literal["float32", "bfloat16"] = "float32",
    overwrite: Overwrite = False,
) -> None:
    """Convert PyTorch weights of VGGT or Depth Anything 3 to one .safetensors, and say what was read and written.

    Args:
        source: a .safetensors file, a sharded one (its index or folder), a .pt or .pth file, or a hub id.
        destination: the .safetensors file to write.
        revision: commit of a hub id.
        config: JSON file with the configuration; that of the published model by default.
        heads: heads to convert, such as camera,depth; by default all heads of the model: camera,depth,points,tracks of
            VGGT, camera,depth,rays of Depth Anything 3.
        dtype: of the written weights.
        overwrite: replace the file if it exists.
    """
    check_file(destination, overwrite=overwrite, sources=[Path(source)])
    report = Report()
    with report.running(), report.stage("convert") as progress:
        from converters import convert as run

        source = at_revision(source, revision)
        names = None if heads is None else [name.strip() for name in heads.split(",")]
        conversion = run(source, destination, dtype=dtype, config=read_config(config), heads=names, progress=progress)
    report.table(conversion.summary())

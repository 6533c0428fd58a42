"""The command `vggtjax export-model`. Does not import jax before it is needed."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import tyro

from vggtjax.commands.arguments import Method
from vggtjax.commands.models import ModelFiles
from vggtjax.commands.report import Report
from vggtjax.errors import InputError
from vggtjax.options import Options
from vggtjax.storage.flags import InWords


def export_model(
    model: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MODEL")],
    /,
    out: Path,
    *,
    frames: int,
    size: Annotated[str, tyro.conf.arg(metavar="WIDTHxHEIGHT")],
    platforms: Annotated[str, tyro.conf.arg(metavar="PLATFORM,PLATFORM")] = "cpu,cuda",
    config: InWords[Path | None] = None,
    fusion: InWords[Path | None] = None,
    options: Method = Options(),
) -> None:
    """Write the reconstruction of clips of one shape as a folder that jax runs without vggtjax.

    Args:
        model: "demo", a converted .safetensors, a PyTorch checkpoint, or a hub id.
        out: folder to write; it must not exist.
        frames: number of frames of every clip.
        size: width and height of the frames in pixels, such as 518x294: multiples of the model's patch size.
        platforms: where the program can run, such as cpu,cuda: some of cpu, cuda, rocm, tpu. None of them needs to be
            here.
        config: JSON file with the configuration of a PyTorch checkpoint that is not VGGT-1B.
        fusion: file of a fitted rule of fusion, as vggtjax fit-fusion writes it; the paper's rule by default.
        options: the method
    """
    sides = re.fullmatch(r"(\d{1,5})x(\d{1,5})", size)
    if sides is None:
        raise InputError(f"size is {size!r}; expected width and height in pixels, such as 518x294")
    width, height = map(int, sides.groups())
    names = tuple(name.strip() for name in platforms.split(","))
    report = Report()
    with report.running():
        from vggtjax.pipeline.artefact import check_artefact, write_artefact

        check_artefact(out, frames, height, width, names, options)
        files = ModelFiles(model=model, config=config, fusion=fusion)
        network, fitted = files.load(report, options, [options.method], runs_here=False)
        write_artefact(
            network,
            out,
            frames=frames,
            height=height,
            width=width,
            platforms=names,
            options=options,
            fusion=fitted,
            on_stage=report.stage,
        )
    report.table(
        {
            "clips": f"{frames} frames of {width} x {height} pixels",
            "method": f"{options.method}, model {network.name}",
            "platforms": ", ".join(names),
            "bytes": sum(path.stat().st_size for path in out.rglob("*") if path.is_file()),
            "artefact": f"{out}/",
            "run it": f"python {out / 'serve.py'} FRAMES.npy --out results",
        }
    )
    if network.note:
        report.line(network.warning)

"""The commands `vggtjax convert`, `vggtjax import` and `vggtjax info`. Do not import jax before it is needed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from vggtjax.interface.commands.arguments import Overwrite, Revision
from vggtjax.interface.commands.flags import InWords
from vggtjax.interface.commands.models import at_revision, load, read_config
from vggtjax.interface.commands.report import Report
from vggtjax.results.saving import ForeignFormat, Saving
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
    """Convert a PyTorch VGGT checkpoint to one .safetensors with Flax names, and say what was read and written.

    Args:
        source: a .safetensors file, a sharded one (its index or folder), a .pt or .pth file, or a hub id.
        destination: the .safetensors file to write.
        revision: commit of a hub id, 40 hexadecimal letters; by default the newest one of the first use.
        config: JSON file with the configuration; that of the published model by default.
        heads: heads to convert, such as camera,depth; all of camera,depth,points,tracks by default.
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


def import_result(
    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FOLDER")],
    /,
    out: Path,
    *,
    format: ForeignFormat,
    quaternion: InWords[Literal["xyzw", "wxyz"] | None] = None,
    confidence_percentile: float = 20.0,
) -> None:
    """Read the result folder of another project, and write it as ours: pictures, clouds, a scene to look at.

    Args:
        source: the folder.
        out: folder for our files; an earlier result in it is replaced.
        format: the program whose files the folder has.
        quaternion: order of the quaternions in pred_traj.txt: wxyz as MonST3R and VGGT4D write it, or xyzw.
        confidence_percentile: percent of the pixels, the least confident, to leave out of the point clouds.
    """
    saving = Saving(confidence_percentile=confidence_percentile)
    report = Report()
    with report.running():
        from vggtjax.results.folder import check_folder
        from vggtjax.results.reconstruction import Reconstruction

        check_folder(out)
        with report.stage("read"):
            result = Reconstruction.load(source, format=format, quaternion=quaternion)
        with report.stage("write") as progress:
            result.save(out, saving=saving, progress=progress)
    report.summary(result, out)


def info(
    model: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="[MODEL|CLIP]")] = "demo",
    /,
    *,
    config: InWords[Path | None] = None,
) -> None:
    """Print a model's configuration, heads, number of parameters and type; or what a clip is.

    Args:
        model: "demo", a converted .safetensors, a PyTorch checkpoint, or a hub id; or a video, a picture, a folder of
            pictures, or a capture: frames, size, length, the focal length that the camera states, the lens.
        config: JSON file with the configuration of a PyTorch checkpoint that is not VGGT-1B.
    """
    report = Report()
    with report.running():
        from vggtjax.interface.commands.clip_facts import clip_facts, is_clip

        if is_clip(Path(model)):
            report.table(clip_facts(model))
            return
        network = load(report, model, config)
    summary = network.summary()
    if network.path is not None:
        summary["bytes"] = f"{summary['bytes']} in memory, {network.path.stat().st_size} in the file"
    report.table(summary | {"dtype": f"{summary['dtype']} in memory"})

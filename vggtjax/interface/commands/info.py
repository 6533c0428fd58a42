"""The command `vggtjax info`. Does not import jax before it is needed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from vggtjax.interface.commands.flags import InWords
from vggtjax.interface.commands.models import load
from vggtjax.interface.commands.report import Report


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
        config: JSON file with the configuration of a PyTorch checkpoint; not needed for published weights (VGGT-1B,
            Depth Anything 3).
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

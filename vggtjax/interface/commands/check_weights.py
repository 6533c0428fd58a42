"""The command `vggtjax check-weights`. Does not import jax before it is needed."""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import tyro

from vggtjax.errors import InputError
from vggtjax.interface.commands.arguments import Overwrite, Revision
from vggtjax.interface.commands.flags import InWords
from vggtjax.interface.commands.models import at_revision, load
from vggtjax.interface.commands.report import Report
from vggtjax.storage.writing import check_free, writing

if TYPE_CHECKING:
    from converters.locate import Weights

_REPORT = "check-weights.md"


def check_weights(
    model: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MODEL")],
    /,
    *,
    peer: Annotated[Path | None, tyro.conf.arg(metavar="CHECKOUT", help_behavior_hint="")] = None,
    frames: int = 4,
    tolerance: float = 1e-4,
    revision: Revision = None,
    config: InWords[Path | None] = None,
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None,
    overwrite: Overwrite = False,
) -> int:
    """Check a model's weights on the embedded clip, alone or beside the public PyTorch code; print a table to paste.

    The weights are converted strictly, as by vggtjax convert. The exit code is 1 where a check does not hold.

    Args:
        model: a hub id such as facebook/VGGT-1B, PyTorch weights, or a converted .safetensors.
        peer: checkout of the public code, whose code is run: a folder with the package vggt, and with vggt4d to compare
            the masked pass too; torch must be installed. By default nothing is compared.
        frames: number of frames of the embedded clip, at the model's own size.
        tolerance: most that an output may differ from the public code's, in standard deviations of its array; tracks
            may differ by 2e-3 pixels, their visibility and confidence by 2e-4.
        revision: commit of a hub id.
        config: JSON file with the configuration; that of the published model by default.
        out: folder for the table, as check-weights.md; by default it is only printed.
        overwrite: replace the file if it exists.
    """
    if not 0 < tolerance < 1:
        raise InputError(f"tolerance is {tolerance}; expected a number between 0 and 1")
    peer = None if peer is None else peer.expanduser().resolve()
    packages = [] if peer is None else _packages(peer)
    if out is not None:
        check_free(out, [_REPORT], replaced=overwrite, what="check")
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # both processes share a GPU
    report = Report()
    with report.running(), TemporaryDirectory() as folder:
        name = at_revision(model, revision)
        with report.stage("read weights"):
            weights, tensors = _source(name)
            if packages and (weights is None or tensors is None):
                raise InputError(
                    f"{model} is in this library's format, which PyTorch cannot read; give --peer the hub id or the "
                    "PyTorch file that it was made from"
                )
        network = load(report, name, config, stage="convert")
        if packages and not network.config.row.world_is_first:
            raise InputError(
                "--peer is VGGT's public code, and the model is of another family; leave it out, or compare passes by "
                "python -m benchmarks speed"
            )
        with report.stage("read clip"):
            import numpy as np

            from vggtjax.research.parity.outputs import parities
            from vggtjax.research.parity.own_run import checks, demo_frames, run_own
            from vggtjax.research.parity.page import model_facts, page
            from vggtjax.research.parity.public_run import Task, run_public

            clip = demo_frames(network, frames)
        theirs, public = {}, None
        if packages and weights is not None:
            read, made = (str(Path(folder) / file) for file in ("frames.npz", "public.npz"))
            np.savez(read, allow_pickle=False, **clip._asdict())
            labels = (weights.name, network.config.to_json())
            with report.stage("public code"):
                theirs, public = run_public(
                    Task(str(peer), str(weights.path), *labels, read, made, masked="vggt4d" in packages)
                )
        with report.stage("this library"):
            own, seconds, equal = run_own(network, clip, masked="vggt4d" in packages)
        found = checks(own, equal)
        rows = parities(own, theirs, tolerance) if public is not None else []
        strict = {} if tensors is None else {"tensors": f"{tensors} of PyTorch in the file; none is unknown or missing"}
        converted = weights.path if weights is not None and tensors is None else None
        text = page(strict | model_facts(network, clip, seconds, public, converted), found, rows)
        if out is not None:
            with writing(out / _REPORT) as temporary:
                temporary.write_text(text, encoding="utf-8")
    for line in text.splitlines():
        report.line(line)
    if failed := [row.name for row in (*found, *rows) if not row.holds]:
        report.note(f"{len(failed)} of {len(found) + len(rows)} checks do not hold: {', '.join(failed)}")
    return 1 if failed else 0


def _packages(peer: Path) -> list[str]:
    """Return the packages of a checkout that are compared; raise InputError without VGGT's, or without torch."""
    if not (peer / "vggt" / "models" / "vggt.py").is_file():
        raise InputError(
            f"{peer} has no file vggt/models/vggt.py; expected a checkout of the public code of VGGT, the folder in "
            "which its package vggt lies"
        )
    if find_spec("torch") is None:
        raise InputError("--peer runs PyTorch code, and torch is not installed; pip install torch, or omit --peer")
    return ["vggt", *(["vggt4d"] if (peer / "vggt4d" / "models" / "vggt4d.py").is_file() else [])]


def _source(name: str) -> tuple[Weights | None, int | None]:
    """Return the file of a model, which is downloaded if need be, and the number of its tensors of PyTorch.

    None stands for the embedded model, which is no file of PyTorch, and for the tensors of converted files.
    """
    from converters.files import read_state_dict
    from converters.locate import locate
    from vggtjax.network.checkpoint import is_checkpoint

    if name == "demo":
        return None, None
    weights = locate(name)
    return weights, None if is_checkpoint(weights.path) else len(read_state_dict(weights.path).tensors)

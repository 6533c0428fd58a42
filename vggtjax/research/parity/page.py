"""A check of weights as Markdown: facts, what holds alone, and what holds beside the public code."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import jax

from vggtjax.errors import one_line
from vggtjax.network.checkpoint import Model
from vggtjax.research.parity.outputs import Parity
from vggtjax.research.parity.own_run import Check, Frames
from vggtjax.research.parity.public_run import Facts
from vggtjax.storage.markdown import markdown_table
from vggtjax.storage.memory import peak_bytes

_YES = {True: "yes", False: "**no**"}


def page(facts: Mapping[str, str], found: Sequence[Check], parity: Sequence[Parity]) -> str:
    """Return the check as Markdown; without `parity`, none was asked for."""
    parts = [
        markdown_table(("model", "value"), facts.items()),
        markdown_table(
            ("check of the model alone", "found", "holds"), ((c.name, c.found, _YES[c.holds]) for c in found)
        ),
    ]
    if parity:
        rows = ((p.name, f"{p.spreads:.1e}", f"{p.largest:.1e}", p.tolerance, _YES[p.holds]) for p in parity)
        heading = ("output beside the public code", "error, std", "largest error", "tolerance", "holds")
        parts.append(markdown_table(heading, rows))
    return "\n".join(parts)


def model_facts(
    model: Model, frames: Frames, own_seconds: float, public: Facts | None, converted: Path | None = None
) -> dict[str, str]:
    """Return what was checked, on what, how fast, and in how much memory; `converted` is the file that was checked."""
    S, H, W = frames.images.shape[:3]
    devices = jax.local_devices()
    times, peaks = [f"vggtjax {own_seconds:.2f} s"], [f"vggtjax {_gigabytes(peak_bytes())}"]
    versions = [f"Python {platform.python_version()}"]
    versions += [f"{name} {version(name)}" for name in ("vggtjax", "jax", "flax")]
    device = f"vggtjax {devices[0].device_kind}"
    if public is not None:
        times.append(f"public code {public.seconds:.2f} s")
        peaks.append(f"public code {_gigabytes(public.peak)}")
        versions.append(f"torch {public.torch}")
        device += f", public code {public.device}"
    return {
        "name": one_line(model.name, 100),
        **({"commit on the hub": model.revision} if model.revision else {}),
        **({} if converted is None else {f"SHA-256 of {one_line(converted.name, 100)}, the file": _digest(converted)}),
        **{f"SHA-256 of {one_line(name, 100)}": digest for name, digest in _sources(model, converted).items()},
        "parameters": f"{model.summary()['parameters']}",
        "weights": model.dtype,
        "heads": ", ".join(model.config.heads),
        "frames": f"{S} of the embedded clip, {W} x {H} pixels, computed in float32",
        "seconds of a pass, with these heads": ", ".join(times),
        "peak memory of the process": ", ".join(peaks),
        "device": device,
        "versions": ", ".join(versions),
    }


def _sources(model: Model, converted: Path | None) -> Mapping[str, str]:
    """Return the digests of the files that a conversion was made of, or of the model's own file."""
    if converted is not None:
        return {f"{name}, its source": digest for name, digest in model.origin.items()}
    return model.origin or ({} if model.path is None else {model.path.name: _digest(model.path)})


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _gigabytes(size: int | None) -> str:
    return "unknown" if size is None else f"{size / 1e9:.2f} GB"

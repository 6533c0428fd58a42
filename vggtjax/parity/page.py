"""A check of weights as Markdown: facts, what holds alone, and what holds beside the public code."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version

import jax

from vggtjax.checkpoint import Model
from vggtjax.errors import one_line
from vggtjax.parity.outputs import Parity
from vggtjax.parity.own_run import Check, Frames
from vggtjax.parity.public_run import Facts
from vggtjax.storage.process_memory import peak_bytes

_YES = {True: "yes", False: "**no**"}


def page(facts: Mapping[str, str], found: Sequence[Check], parity: Sequence[Parity]) -> str:
    """Return the check as Markdown; without `parity`, none was asked for."""
    parts = [
        _table(("model", "value"), facts.items()),
        _table(("check of the model alone", "found", "holds"), ((c.name, c.found, _YES[c.holds]) for c in found)),
    ]
    if parity:
        rows = ((p.name, f"{p.spreads:.1e}", f"{p.largest:.1e}", p.tolerance, _YES[p.holds]) for p in parity)
        heading = ("output beside the public code", "error, std", "largest error", "tolerance", "holds")
        parts.append(_table(heading, rows))
    return "\n".join(parts)


def model_facts(model: Model, frames: Frames, own_seconds: float, public: Facts | None) -> dict[str, str]:
    """Return what was checked, on what, how fast, and in how much memory."""
    S, H, W = frames.images.shape[:3]
    devices = jax.local_devices()
    times, peaks, versions = [f"vggtjax {own_seconds:.2f} s"], [f"vggtjax {_gigabytes(peak_bytes())}"], _versions()
    device = f"vggtjax {devices[0].device_kind}"
    if public is not None:
        times.append(f"public code {public.seconds:.2f} s")
        peaks.append(f"public code {_gigabytes(public.peak)}")
        versions.append(f"torch {public.torch}")
        device += f", public code {public.device}"
    return {
        "name": one_line(model.name, 100),
        **({"commit on the hub": model.revision} if model.revision else {}),
        **{f"SHA-256 of {one_line(name, 100)}": digest for name, digest in _digests(model).items()},
        "parameters": f"{model.summary()['parameters']}",
        "heads": ", ".join(model.config.heads),
        "frames": f"{S} of the embedded clip, {W} x {H} pixels, float32",
        "seconds of a pass, all heads": ", ".join(times),
        "peak memory of the process": ", ".join(peaks),
        "device": device,
        "versions": ", ".join(versions),
    }


def _digests(model: Model) -> Mapping[str, str]:
    if model.origin or model.path is None:
        return model.origin
    with model.path.open("rb") as file:
        return {model.path.name: hashlib.file_digest(file, "sha256").hexdigest()}


def _versions() -> list[str]:
    return [f"Python {platform.python_version()}", *(f"{name} {version(name)}" for name in ("vggtjax", "jax", "flax"))]


def _gigabytes(size: int | None) -> str:
    return "unknown" if size is None else f"{size / 1e9:.2f} GB"


def _table(heading: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [heading, ["---"] * len(heading), *rows]
    return "".join(f"| {' | '.join(cell.replace('|', '/') for cell in line)} |\n" for line in lines)

"""How far the numbers of one clip are apart from one way of running it to another: python -m benchmarks determinism."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from vggtjax.errors import InputError

_ROOT = Path(__file__).parents[1]
_SCRIPT = """
import os, sys
way, frames, model, out = sys.argv[1], int(sys.argv[2]), *sys.argv[3:]
if way == "one core":
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import jax.numpy as jnp, numpy as np, vggtjax
from vggtjax.pipeline.run import assembled_fields
from vggtjax.pretrained.embedded import demo_clip
model, pictures = vggtjax.load_model(model), demo_clip().images
pictures = np.concatenate([pictures, pictures[::-1]] * (1 + frames // 32))[:frames]
size, patch = model.config.image_size, model.config.patch_size
clip = vggtjax.load_clip(pictures, size=size, patch=patch)
if way in ("one program", "beside another clip"):
    clips = [clip.images] if way == "one program" else [clip.images, clip.images[::-1]]
    assembly, passes = vggtjax.infer(model.params, jnp.asarray(np.stack(clips)), model.config)
    fields = assembled_fields(assembly, passes.second) | {"dynamic_mask": passes.dynamic_mask[0]}
else:
    options = {"padded": {"pad_frames": True}, "bfloat16": {"compute_dtype": "bfloat16"}}.get(way, {})
    if way.endswith("devices"):
        options = {"devices": int(way.split()[0])}
    fields = vars(vggtjax.reconstruct(model, clip, size=size, **options))
names = ("depth", "depth_confidence", "camera_from_world", "intrinsics", "dynamic_mask")
np.savez(out, **{name: np.asarray(fields[name]) for name in names})
"""
WAYS = {
    "again": "the same, in another process",
    "one core": "on one core",
    "one program": "under one jit (`infer`)",
    "beside another clip": "in a batch of two clips",
    "padded": "padded to a shared length",
    "2 devices": "frames shared by 2 devices",
    "8 devices": "frames shared by 8 devices",
    "bfloat16": "blocks in bfloat16",
}


class Apart(NamedTuple):
    """How far two results are apart."""

    equal: bool  # every byte
    depth: float  # largest difference, as a share of the pixel's depth
    mean_depth: float
    confidence: float  # likewise
    rotation: float  # of the worst frame, in degrees
    centre: float  # of the worst frame, as a share of the extent of all centres
    mask: float  # share of the pixels


def determinism(*, frames: int = 17, model: str = "demo", ways: tuple[str, ...] = tuple(WAYS)) -> None:
    """Run one clip in several ways, each in a process of its own, and compare the results with those of the plain way.

    The clip is the embedded one, there and back; each way takes half a minute.

    Args:
        frames: of the clip. 17 are padded to 18, and no number of devices divides them.
        model: "demo", or weights as for vggtjax reconstruct.
        ways: which of them; all by default.
    """
    if unknown := [way for way in ways if way not in WAYS]:
        raise InputError(f"ways has {unknown[0]!r}; expected some of {', '.join(WAYS)}")
    if frames < 2:
        raise InputError(f"frames is {frames}; expected at least 2")
    console = Console()
    with TemporaryDirectory() as folder:
        plain = run("plain", frames, model, Path(folder))
        rows = {
            way: apart(plain, run(way, frames, model, Path(folder))) for way in track(ways, "runs", console=console)
        }
    table = Table(title=f"{frames} frames: largest differences from the plain way", title_justify="left")
    for heading in ("way", "bytes", "depth", "its mean", "confidence", "rotation", "centres", "mask"):
        table.add_column(heading, justify="left" if heading in ("way", "bytes") else "right")
    for way, row in rows.items():
        depth = (f"{row.depth:.1e}", f"{row.mean_depth:.1e}", f"{row.confidence:.1e}")
        numbers = (*depth, f"{row.rotation:.1e}°", f"{row.centre:.1e}")
        table.add_row(WAYS[way], "equal" if row.equal else "differ", *numbers, f"{100 * row.mask:.3f} %")
    console.print(table)


def run(way: str, frames: int, model: str, folder: Path) -> dict[str, np.ndarray]:
    """Return the arrays of a result that a process of its own computes."""
    out = folder / f"{way}.npz"
    environment = os.environ | {"PYTHONPATH": str(_ROOT), "JAX_PLATFORMS": "cpu"}
    if way.endswith("devices"):
        count = f"--xla_force_host_platform_device_count={way.split()[0]}"
        environment["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {count}"
    words = [sys.executable, "-c", _SCRIPT, way, str(frames), model, str(out)]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise InputError(f"the way {way!r} failed: {' '.join(done.stderr.split())[-300:]}")
    with np.load(out) as arrays:
        return dict(arrays)


def apart(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> Apart:
    """Return how far two results are apart."""
    turns = np.einsum("sij,skj->sik", other["camera_from_world"][..., :3], one["camera_from_world"][..., :3])
    sines = np.linalg.norm(turns - turns.swapaxes(1, 2), axis=(1, 2)) / np.sqrt(8)
    centres = [
        -np.einsum("sji,sj->si", x["camera_from_world"][..., :3], x["camera_from_world"][..., 3]) for x in (one, other)
    ]
    extent = np.linalg.norm(np.ptp(centres[0], axis=0))
    depth, confidence = (np.abs(other[name] / one[name] - 1) for name in ("depth", "depth_confidence"))
    return Apart(
        equal=all(one[name].tobytes() == other[name].tobytes() for name in one),
        depth=float(depth.max()),
        mean_depth=float(depth.mean()),
        confidence=float(confidence.max()),
        rotation=float(np.degrees(np.arcsin(np.minimum(sines, 1))).max()),
        centre=float(np.linalg.norm(centres[1] - centres[0], axis=1).max() / extent),
        mask=float((one["dynamic_mask"] != other["dynamic_mask"]).mean()),
    )

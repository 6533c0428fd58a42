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
frames, model, folder, *ways = sys.argv[1:]
if "one core" in ways:
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import jax.numpy as jnp, numpy as np, vggtjax
from vggtjax.pipeline.run import assembled_fields
from vggtjax.pretrained.embedded import demo_clip
model, pictures = vggtjax.load_model(model), demo_clip().images
pictures = np.concatenate([pictures, pictures[::-1]] * (1 + int(frames) // 32))[:int(frames)]
size, patch = model.config.image_size, model.config.patch_size
clip = vggtjax.load_clip(pictures, size=size, patch=patch)
for way in ways:
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
    np.savez(f"{folder}/{way}.npz", **{name: np.asarray(fields[name]) for name in names})
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
_PROCESSES = (  # ways that share a process
    ("plain", "one program", "beside another clip", "padded", "bfloat16"),
    ("again",),
    ("one core",),
    ("2 devices", "8 devices"),
)


class Apart(NamedTuple):
    """How far two results are apart."""

    equal: bool  # every byte
    depth: float  # largest difference, as a share of the pixel's depth
    mean_depth: float
    confidence: float  # likewise
    rotation: float  # of the worst frame, in degrees
    centre: float  # of the worst frame, as a share of the extent of all centres
    focal: float  # focal lengths, as a share
    mask: float  # share of the pixels

    def within(self, most: Apart) -> bool:
        """Whether no difference is larger than in `most`."""
        return all(mine <= limit for mine, limit in zip(self[1:], most[1:], strict=True)) and self.equal >= most.equal


_EQUAL = Apart(equal=True, depth=0, mean_depth=0, confidence=0, rotation=0, centre=0, focal=0, mask=0)
_ROUNDED = Apart(
    equal=False, depth=1e-5, mean_depth=1e-6, confidence=2e-5, rotation=1e-4, centre=5e-6, focal=2e-6, mask=1e-4
)
_COARSE = Apart(equal=False, depth=2, mean_depth=0.01, confidence=4, rotation=5, centre=0.1, focal=0.02, mask=0.01)
MOST = dict.fromkeys(WAYS, _ROUNDED) | {"again": _EQUAL, "bfloat16": _COARSE}  # that tests allow


def determinism(*, frames: int = 17, model: str = "demo", ways: tuple[str, ...] = tuple(WAYS)) -> None:
    """Run one clip in several ways, and compare the results with those of the plain way.

    The clip is the embedded one, there and back. The ways that need other settings run in processes of their own.

    Args:
        frames: of the clip. 17 are padded to 18, and no number of devices divides them.
        model: "demo", or weights as for vggtjax reconstruct.
        ways: which of them; all by default.
    """
    if unknown := [way for way in ways if way not in WAYS]:
        raise InputError(f"ways has {unknown[0]!r}; expected some of {', '.join(WAYS)}")
    if frames < 2:
        raise InputError(f"frames is {frames}; expected at least 2")
    rows = differences(frames, model, ways)
    console = Console()
    table = Table(title=f"{frames} frames: largest differences from the plain way", title_justify="left")
    for heading in ("way", "bytes", "depth", "its mean", "confidence", "rotation", "centres", "focal", "mask"):
        table.add_column(heading, justify="left" if heading in ("way", "bytes") else "right")
    for way, row in rows.items():
        depth = (f"{row.depth:.1e}", f"{row.mean_depth:.1e}", f"{row.confidence:.1e}")
        numbers = (*depth, f"{row.rotation:.1e}°", f"{row.centre:.1e}", f"{row.focal:.1e}")
        table.add_row(WAYS[way], "equal" if row.equal else "differ", *numbers, f"{100 * row.mask:.3f} %")
    console.print(table)


def differences(frames: int, model: str, ways: tuple[str, ...]) -> dict[str, Apart]:
    """Return how far the result of each way is apart from the plain one's."""
    kept: dict[str, dict[str, np.ndarray]] = {}
    with TemporaryDirectory() as folder:
        for group in track(_PROCESSES, "processes"):
            if wanted := [way for way in group if way in ways or way == "plain"]:
                kept |= _run(wanted, frames, model, Path(folder))
    return {way: apart(kept["plain"], kept[way]) for way in ways}


def _run(ways: list[str], frames: int, model: str, folder: Path) -> dict[str, dict[str, np.ndarray]]:
    """Return the arrays of each way, which a process of their own computes."""
    environment = os.environ | {"PYTHONPATH": str(_ROOT), "JAX_PLATFORMS": "cpu"}
    if counts := [int(way.split()[0]) for way in ways if way.endswith("devices")]:
        count = f"--xla_force_host_platform_device_count={max(counts)}"
        environment["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {count}"
        environment["PJRT_NPROC"] = str(2 * max(counts))  # threads: devices that wait for each other hold one each
    words = [sys.executable, "-c", _SCRIPT, str(frames), model, str(folder), *ways]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise InputError(f"the ways {', '.join(ways)} failed: {' '.join(done.stderr.split())[:600]}")
    kept = {}
    for way in ways:
        with np.load(folder / f"{way}.npz") as arrays:
            kept[way] = dict(arrays)
    return kept


def apart(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> Apart:
    """Return how far two results are apart."""
    turns = np.einsum("sij,skj->sik", other["camera_from_world"][..., :3], one["camera_from_world"][..., :3])
    sines = np.linalg.norm(turns - turns.swapaxes(1, 2), axis=(1, 2)) / np.sqrt(8)
    centres = [
        -np.einsum("sji,sj->si", x["camera_from_world"][..., :3], x["camera_from_world"][..., 3]) for x in (one, other)
    ]
    extent = np.linalg.norm(np.ptp(centres[0], axis=0))
    depth, confidence = (np.abs(other[name] / one[name] - 1) for name in ("depth", "depth_confidence"))
    focal = np.abs(other["intrinsics"][:, [0, 1], [0, 1]] / one["intrinsics"][:, [0, 1], [0, 1]] - 1)
    return Apart(
        equal=all(one[name].tobytes() == other[name].tobytes() for name in one),
        depth=float(depth.max()),
        mean_depth=float(depth.mean()),
        confidence=float(confidence.max()),
        rotation=float(np.degrees(np.arcsin(np.minimum(sines, 1))).max()),
        centre=float(np.linalg.norm(centres[1] - centres[0], axis=1).max() / extent),
        focal=float(focal.max()),
        mask=float((one["dynamic_mask"] != other["dynamic_mask"]).mean()),
    )

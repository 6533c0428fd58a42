"""The files of VGGT4D's results, written; `foreign` reads them. Does not import jax."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image

from vggtjax.results.frame import ResultFrame
from vggtjax.storage.trajectories import write_trajectory


def write_frame(folder: Path, number: int, frame: ResultFrame, *, mask: bool = True) -> None:
    """Write a frame as VGGT4D does, with its mask if there is one."""
    Image.fromarray(frame.image).save(folder / f"frame_{number:04d}.png")
    np.save(folder / f"frame_{number:04d}.npy", frame.depth, allow_pickle=False)
    np.save(folder / f"conf_{number:04d}.npy", frame.confidence, allow_pickle=False)
    if mask:
        moving = Image.fromarray(frame.dynamic_mask.astype(np.uint8) * 255)
        moving.save(folder / f"dynamic_mask_{number:04d}.png")


def write_cameras(
    folder: Path, world_from_camera: Float[np.ndarray, "S 4 4"], intrinsics: Sequence[Float[np.ndarray, "3 3"]]
) -> None:
    """Write the cameras as VGGT4D does."""
    np.savetxt(folder / "pred_intrinsics.txt", np.stack(intrinsics).reshape(-1, 9), fmt="%.9g")
    numbers = np.arange(len(world_from_camera), dtype=np.float64)
    write_trajectory(folder / "pred_traj.txt", world_from_camera, numbers, quaternion="wxyz")

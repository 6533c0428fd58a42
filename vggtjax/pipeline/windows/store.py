"""The results of windows on disk, so that a killed run goes on where it stopped. Does not import jax.

In the folder of the result, while it is being made:

    .vggtjax-windows/DIGEST/    DIGEST stands for all that decides the windows
        0000.npz                the archive of a window's result
        0000.npy                features of some of its frames, for finding loops
        joined/                 arrays of the whole clip
    .vggtjax-windows/cut.json   frames of a window and overlap, for a run that goes on
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from vggtjax.errors import InputError, OutputError, ResultError
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.storage.arrays import read_array
from vggtjax.storage.json_values import read_json
from vggtjax.storage.writing import locked_folder, write_errors, writing

FOLDER = ".vggtjax-windows"
_CUT = "cut.json"


def write_cut(out: Path, window: int, overlap: int) -> None:
    """Note how the clip of a result's folder is cut, until the result is whole."""
    with writing(out / FOLDER / _CUT) as path:
        path.write_text(json.dumps([window, overlap]))


def unfinished_cut(out: Path) -> tuple[int, int] | None:
    """Return the frames of a window and the overlap of a run that was stopped; None without one."""
    try:
        return read_json(out / FOLDER / _CUT, tuple[int, int], "the cut of a clip")
    except InputError:
        return None


def discard(out: Path) -> None:
    """Remove what a stopped run in windows left in a result's folder, unless a run is writing it."""
    if (out / FOLDER).is_dir():
        with suppress(OutputError), locked_folder(out / FOLDER, "the windows of a clip"):
            shutil.rmtree(out / FOLDER, ignore_errors=True)


class WindowStore:
    """Windows by name, such as "0003", or "loop-0001-0012" for one that closes a loop."""

    def __init__(self, out: Path, settings: Mapping[str, Any]) -> None:
        text = json.dumps(settings, sort_keys=True, default=str)
        self._root = out / FOLDER
        self._folder = self._root / hashlib.sha256(text.encode()).hexdigest()[:16]
        with write_errors(self._folder):
            self._folder.mkdir(parents=True, exist_ok=True)
            for other in self._root.iterdir():  # of runs with other settings
                if other != self._folder and other.is_dir():
                    shutil.rmtree(other, ignore_errors=True)

    def find(self, name: str, frame_names: Sequence[str], images: np.ndarray) -> Reconstruction | None:
        """Return the stored result of a window, or None where there is none of exactly these frames."""
        with suppress(ResultError):
            result = self.load(name)
            if result.frame_names == tuple(frame_names) and np.array_equal(result.images, images):
                return result
        return None

    def count(self) -> int:
        """Return how many windows of the clip are stored, without those that close loops."""
        return sum(path.stem.isdecimal() for path in self._folder.glob("*.npz"))

    def load(self, name: str) -> Reconstruction:
        """Return the stored result of a window. Raises ResultError where there is none."""
        return Reconstruction.load(self._folder / f"{name}.npz")

    def features(self, names: Sequence[str], frames: int) -> list[Float32[np.ndarray, "F C"]]:
        """Return the stored features of windows, of as many frames each.

        Raises ResultError for files that are not finite features of one length.
        """
        try:
            features = [read_array(self._folder / f"{name}.npy") for name in names]
            shape = (frames, *features[0].shape[1:2])
            if not all(
                part.shape == shape and part.dtype == np.float32 and np.isfinite(part).all() for part in features
            ):
                raise ResultError("the features of the windows do not fit together")
        except ResultError as error:
            raise ResultError(f"{error}; delete {self._root}, and the windows are run again") from error
        return features

    def save(self, name: str, result: Reconstruction, features: Float32[np.ndarray, "F C"] | None = None) -> None:
        """Store a window; the archive comes last and whole, so that a window is there or not."""
        if features is not None:
            with writing(self._folder / f"{name}.npy") as path, path.open("wb") as file:
                np.save(file, features, allow_pickle=False)
        with writing(self._folder / f"{name}.npz") as path:
            result.save_archive(path)

    def arrays(self, shapes: Mapping[str, tuple[np.dtype, tuple[int, ...]]]) -> dict[str, np.memmap]:
        """Return new arrays on disk, for the whole clip."""
        folder = self._folder / "joined"
        with write_errors(folder):
            folder.mkdir(exist_ok=True)
            return {
                name: np.lib.format.open_memmap(folder / f"{name}.npy", "w+", dtype, shape)
                for name, (dtype, shape) in shapes.items()
            }

    def remove(self) -> None:
        """Remove everything, once the whole result is written."""
        shutil.rmtree(self._root, ignore_errors=True)

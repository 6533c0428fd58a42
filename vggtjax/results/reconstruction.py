"""A result that is saved and loaded: cameras, depth, dynamic masks, and everything needed to use them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

import numpy as np
from jaxtyping import UInt8

from vggtjax.errors import ClipError, ResultError
from vggtjax.progress import Progress, no_progress
from vggtjax.results.archive import ARCHIVE_NAME, read_archive, write_archive
from vggtjax.results.folder import find_archive, replacing
from vggtjax.results.result import Result
from vggtjax.results.saving import Saving, SavingChanges
from vggtjax.storage.writing import writing

if TYPE_CHECKING:
    from vggtjax.results.report import RunFacts
    from vggtjax.results.viewer.page import Viewer
    from vggtjax.storage.trajectories import Quaternion

_DEFAULT = Saving()


class Reconstruction(Result):
    __doc__ = Result.__doc__

    def save(
        self,
        folder: str | Path,
        *,
        saving: Saving = _DEFAULT,
        pictures: Iterable[UInt8[np.ndarray, "h w 3"]] | None = None,
        progress: Progress | None = None,
        facts: RunFacts | None = None,
        **changes: Unpack[SavingChanges],
    ) -> None:
        """Write the result into `folder`, made if missing; see vggtjax.results.export for the files.

        An earlier result in the folder is replaced as a whole, or left untouched if anything fails; other files stay.
        If the process is killed, `load` reads the earlier or the new result, and the next `save` tidies the folder.

        Args:
            folder: may be missing.
            saving: share left out of the point clouds, size of the files, format.
            pictures: for the resolution "original", the source's (`Clip.pictures()`); by default the model's enlarged.
            progress: called with the number of steps done, and of all.
            facts: what report.html says of the run beside the result: times of the stages, errors against the truth.
            changes: single values of `saving`, such as `resolution="original"`.

        Raises:
            InputError: a percentile outside [0, 100), an unknown name, or pictures that do not fit.
            OutputError: the folder cannot be written, has too little space, or holds files of the same names that are
                no earlier result.
        """
        from vggtjax.results.disk import check_space, forecast_bytes
        from vggtjax.results.export import check_saving, write_files

        saving = replace(saving, **changes)
        check_saving(self, saving, pictures)
        check_space(folder, forecast_bytes(self.depth.shape, self.source_size, saving))
        names = saving.names(tracks=self.track_positions is not None)
        with replacing(Path(folder), names) as staged:
            total = write_files(self, staged, saving, pictures, progress, facts)
            with writing(staged / ARCHIVE_NAME) as path:
                self.save_archive(path, files=[name for name in names if (staged / name).exists()])
            (progress or no_progress)(total, total)

    def save_archive(self, path: Path, *, files: Sequence[str] = ()) -> None:
        """Write all fields but `passes` to one compressed .npz file; `files` are the names beside it."""
        write_archive(path, self, files)

    def view(self, *others: Result, names: Sequence[str] | None = None, height: int = 600) -> Viewer:
        """Return a page that plays the result: a notebook shows it in its cell, `.save(path)` writes it to a file.

        Args:
            others: results to compare with, side by side or swapped by a key; up to eight.
            names: one for each result; by default their methods and models.
            height: of the cell, in pixels.

        Raises InputError for too many results, or another number of names.
        """
        from vggtjax.results.viewer.page import Viewer, viewer_page

        return Viewer(viewer_page([self, *others], names=names), height)

    @classmethod
    def load(cls, path: str | Path, *, format: str = "vggtjax", quaternion: Quaternion | None = None) -> Reconstruction:
        """Read a result back from its folder, or from its reconstruction.npz; or the folder of another program.

        Args:
            path: the folder or file.
            format: "vggtjax", or "vggt4d", "monst3r", "easi3r", "das3r", "pomato", "cut3r", "da3", "spatialtrackerv2"
                (vggtjax.results.foreign). Fields that such a folder lacks get plain values (confidence 1, nothing
                moves, grey pictures), with a warning logged, and are named in `settings["missing"]`; the saliency is
                None.
            quaternion: for formats with a pred_traj.txt ("vggt4d" to "pomato"), the order of its quaternions: "wxyz"
                as these programs and this library write it, "xyzw" as earlier versions of this library did.

        Raises:
            ResultError: anything but a whole result, of a known version.
            InputError: an unknown format, or a quaternion order that is missing or unknown.
        """
        if not isinstance(path, str | os.PathLike):
            raise ResultError(f"the path is a {type(path).__name__}; expected the folder of a result, as str or Path")
        path = Path(path)
        if format != "vggtjax":
            from vggtjax.results.foreign import read_foreign

            try:
                return cls(**read_foreign(path, format, quaternion))
            except (ClipError, ResultError) as error:
                raise ResultError(f"{path} cannot be loaded as a result of {format}: {error}") from error
        file = find_archive(path) if path.is_dir() else path
        if not file.is_file():
            raise ResultError(f"there is no {file}; give the folder of a saved result or its {ARCHIVE_NAME}")
        try:
            return cls(**read_archive(file))
        except ResultError as error:
            raise ResultError(f"{file} cannot be loaded as a result: {error}") from error

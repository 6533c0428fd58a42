"""Rows of what a run reads of an earlier one in its folder: settings of a batch, states of a fit, an evaluation."""

from __future__ import annotations

from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from tests.fuzz import samples
from tests.fuzz.cases import Reader
from vggtjax.errors import InputError
from vggtjax.evaluation.page import is_report
from vggtjax.pipeline.destination import SETTINGS_NAME, LocalFolder, RemoteFolder

_SETTINGS = {"model": "tiny", "method": "vggt", "size": 28, "outputs": ["depth", "mask"], "frames": None}


def _read_remote_settings(path: Path) -> None:
    """Read settings as those of a batch at a URL, whose server gives what the file holds."""
    content = path.read_bytes() if path.is_file() and not path.is_symlink() else None
    with (
        patch("vggtjax.pipeline.destination.read_url", return_value=content),
        patch("vggtjax.pipeline.destination.write_url"),
    ):
        RemoteFolder("s3://bucket/results").begin(_SETTINGS)


@cache
def _fit() -> tuple[Any, ...]:
    """Return clips to fit to, clips that are held out, and settings: two evaluations after the first."""
    import jax

    from tests.simulated import simulate
    from vggtjax.learning.fit import FitClips, FitConfig
    from vggtjax.method.fusion_family import identity

    clips = [FitClips(*simulate(jax.random.key(seed), identity(), (2, 1, 1, 20))) for seed in (0, 1)]
    return *clips, FitConfig(("scale",), steps=20, clips_at_once=1)


def _state(folder: Path) -> Path:
    """Write the state of a fit that was interrupted after ten of its twenty steps."""
    from vggtjax.learning.fit import fit_fusion

    def stop(_done: int, _total: int | None) -> None:
        raise KeyboardInterrupt

    with suppress(KeyboardInterrupt):
        fit_fusion(*_fit(), checkpoint=folder / "state.npz", progress=stop)
    return folder / "state.npz"


def _go_on(path: Path) -> None:
    from vggtjax.learning.fit import fit_fusion

    blocked = patch("vggtjax.learning.fit._keep")  # a folder in place of the file
    with blocked, suppress(InputError):  # parameters that give a loss without a value
        outcome = fit_fusion(*_fit(), checkpoint=path)
        assert len(outcome.losses) == 3
        assert np.isfinite(outcome.losses).all(), "a damaged state is gone on from"


_EVALUATION = {
    "settings": {"dataset": "plain", "methods": ["vggt"]},
    "sequences": [{"name": "a", "method": "vggt", "metrics": {"abs_rel": 0.1}, "notes": []}],
    "mean": {"vggt": {"abs_rel": 0.1}},
    "seconds": {"vggt": {"depth": 0.5}},
}

ROWS = (
    Reader(
        "settings of a batch",
        samples.json_file(SETTINGS_NAME, _SETTINGS),
        lambda path: LocalFolder(path.parent).begin(_SETTINGS),
    ),
    Reader("settings at a URL", samples.json_file(SETTINGS_NAME, _SETTINGS), _read_remote_settings),
    Reader("state of a fit", _state, _go_on, 2**26 + 2**23),  # as much as an archive of arrays may declare
    Reader("evaluation", samples.json_file("results.json", _EVALUATION), is_report),
)

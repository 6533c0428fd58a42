"""What several commands read: sequences of equal sizes, so that all of them run the same few programs."""

from pathlib import Path

import numpy as np
import pytest

from tests.shared.dataset_files import write_plain
from vggtjax.clips.truth import Truth
from vggtjax.pipeline.pretrained.embedded import demo_clip
from vggtjax.research.learning.export import PICTURES

FRAMES = 4


@pytest.fixture(scope="session")
def sequences(tmp_path_factory) -> Path:
    """Four sequences in the plain layout, each of four frames of the embedded clip; depth of a sixteenth of the pixels.

    So few points are enough to score, and soon looked up.
    """
    root, clip = tmp_path_factory.mktemp("sequences"), demo_clip()
    depth = np.zeros_like(clip.depth)
    depth[:, ::4, ::4] = clip.depth[:, ::4, ::4]
    clip = clip._replace(depth=depth)
    for start in range(0, len(depth), FRAMES):
        frames = slice(start, start + FRAMES)
        write_plain(root / f"clip{start // FRAMES}", Truth(*(array[frames] for array in clip)), first=start)
    return root


@pytest.fixture(autouse=True)
def _empty_reports(empty_reports):
    pass


@pytest.fixture
def no_plots(monkeypatch):
    """Leave out the plots of an evaluation and of a fit, which take most of the time and are drawn in one test each."""
    monkeypatch.setattr("vggtjax.research.evaluation.page.draw_sequence", lambda *_: [])

    def draw_nothing(folder: Path, *_) -> None:
        for name in PICTURES:
            (folder / name).touch()

    monkeypatch.setattr("vggtjax.research.learning.export.draw_fits", draw_nothing)

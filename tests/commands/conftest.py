"""What several commands read: sequences of equal sizes, so that all of them run the same few programs."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vggtjax import cameras as geometry
from vggtjax.learning.export import PICTURES
from vggtjax.pretrained.embedded import demo_clip

FRAMES = 4


@pytest.fixture(scope="session")
def sequences(tmp_path_factory) -> Path:
    """Four sequences in the plain layout, each of four frames of the embedded clip; depth of a sixteenth of the pixels.

    So few points are enough to score, and soon looked up.
    """
    root, clip = tmp_path_factory.mktemp("sequences"), demo_clip()
    depth = np.zeros(clip.depth.shape, np.uint16)
    depth[:, ::4, ::4] = np.rint(1000 * clip.depth[:, ::4, ::4])
    poses = geometry.world_from_camera(np.asarray(clip.camera_from_world))
    for start in range(0, len(clip.images), FRAMES):
        folder = root / f"clip{start // FRAMES}"
        for below in ("rgb", "depth", "mask"):
            (folder / below).mkdir(parents=True)
        for i in range(start, start + FRAMES):
            Image.fromarray(np.rint(255 * clip.images[i]).astype(np.uint8)).save(folder / f"rgb/{i:05d}.png")
            Image.fromarray(depth[i]).save(folder / f"depth/{i:05d}.png")
            Image.fromarray(clip.dynamic_mask[i].astype(np.uint8) * 255).save(folder / f"mask/{i:05d}.png")
        np.savetxt(folder / "K.txt", clip.intrinsics[0])
        np.savetxt(folder / "world_from_camera.txt", poses[start : start + FRAMES].reshape(FRAMES, 16))
    return root


@pytest.fixture(autouse=True)
def _empty_reports(empty_reports):
    pass


@pytest.fixture
def no_plots(monkeypatch):
    """Leave out the plots of an evaluation and of a fit, which take most of the time and are drawn in one test each."""
    monkeypatch.setattr("vggtjax.evaluation.page.draw_sequence", lambda *_: [])

    def draw_nothing(folder: Path, *_) -> None:
        for name in PICTURES:
            (folder / name).touch()

    monkeypatch.setattr("vggtjax.learning.export.draw_fits", draw_nothing)

"""The forecast of what a result takes on the disk."""

from types import SimpleNamespace

import numpy as np
import pytest

from tests.shared.room import make_room
from vggtjax.errors import OutputError
from vggtjax.results import disk
from vggtjax.results.disk import forecast_bytes
from vggtjax.results.saving import Saving

SAVINGS = [Saving(resolution="original", format="vggt4d"), Saving(only=("clouds",))]


@pytest.mark.parametrize("saving", SAVINGS)
def test_the_forecast_is_right_within_a_factor_of_two(tmp_path, saving):
    random = np.random.default_rng(0)
    noise = random.integers(0, 60, (2, 112, 154, 3))
    plain = make_room(2, 112, 154)
    room = make_room(2, 112, 154, images=(plain.images // 2 + noise).astype(np.uint8))
    room.save(tmp_path, saving=saving)
    written = sum(path.stat().st_size for path in tmp_path.rglob("*") if path.is_file())
    assert 0.5 < forecast_bytes(room.depth.shape, room.source_size, saving) / written < 2


def test_too_little_space_is_said_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(disk.shutil, "disk_usage", lambda _: SimpleNamespace(free=1000))
    words = r"takes about [0-9.]+ kB and the disk of .* has 1.0 kB left; free some, .*--only"
    with pytest.raises(OutputError, match=words):
        make_room(1).save(tmp_path / "new")
    assert not (tmp_path / "new").exists()

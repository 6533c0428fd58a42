import json
import re
from functools import partial

import jax
import numpy as np
import pytest

from vggtjax.config import vggt_1b
from vggtjax.interface.commands import doctor
from vggtjax.interface.commands import main as cli
from vggtjax.pipeline import memory
from vggtjax.pipeline.pretrained.embedded import demo_model
from vggtjax.pipeline.windows.choice import Planned
from vggtjax.storage.cache import CONVERTED, cache_parts, clear_cache


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A cache folder with an entry of every kind, and with files of someone else."""
    monkeypatch.setenv("VGGTJAX_CACHE", str(tmp_path / "cache"))
    kinds = "compiled/a-cache lowered/b.bin texts/e.bin passes/c.npz trials/d.json mine.safetensors"
    for name in (*kinds.split(), f"m-{'0' * 16}.safetensors"):
        path = tmp_path / "cache" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"four")
    return tmp_path / "cache"


def test_facts_as_json(cache, capsys):
    assert cli.main(["doctor", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["versions"]["jax"].count(".") == 2
    assert found["cache"] == {"folder": str(cache), "bytes": 24, "parts": dict.fromkeys(cache_parts(), 4)}
    assert found["devices"][0]["platform"] == "cpu"
    clip = {clip["model"]: clip for clip in found["clips"]}["demo"]
    assert (clip["width"], clip["height"]) == (96, 56)
    if clip["frames"] is not None:  # the system tells its memory
        free = min(room["bytes"] for room in found["memory"]["room"])
        frames = memory.most_frames(demo_model(), 56, 96, free)
        assert clip["frames"] == pytest.approx(frames, rel=0.3)  # the process has changed since


class _Gpu:
    """What jax tells of a GPU; nothing of its memory without a limit."""

    platform, device_kind = "gpu", "a GPU of a test"

    def __init__(self, limit=None, used=0):
        self._stats = None if limit is None else {"bytes_limit": limit, "bytes_in_use": used}

    def memory_stats(self):
        return self._stats


def use_gpu(monkeypatch, *memory_of_gpu):
    monkeypatch.setattr(memory, "has_accelerator", lambda: True)
    monkeypatch.setattr(jax, "local_devices", lambda: [_Gpu(*memory_of_gpu)])


def test_the_longest_clip_of_a_gpu_leaves_room_for_the_weights(monkeypatch):
    """No model is loaded, so its weights have to fit beside the clip in what is free."""
    models = {dtype: Planned(vggt_1b(), size * 1_257_000_000) for dtype, size in (("float32", 4), ("bfloat16", 2))}
    monkeypatch.setattr(doctor, "_known_models", models.items)

    def longest(*memory_of_gpu):
        use_gpu(monkeypatch, *memory_of_gpu)
        return {clip["model"]: clip for clip in doctor._longest_clips()}

    for limit, used in ((4e9, 5e8), (12e9, 1e9)):
        for dtype, clip in longest(limit, used).items():
            needed = partial(memory.predicted_bytes, models[dtype], height=clip["height"], width=clip["width"])
            sizes = [needed(frames=clip["frames"] + more) for more in (0, 1)]
            assert (sizes[0] if clip["frames"] else 0) <= limit - used < sizes[1]
    small, unknown = longest(4e9, 5e8), longest()
    assert small["float32"]["frames"] == 0 < small["bfloat16"]["frames"]
    assert doctor._longest(small["float32"]) == "no clip of 518 x 294 pixels fits"
    assert doctor._longest({**small["bfloat16"], "frames": 1}) == "1 frame of 518 x 294 pixels"
    assert doctor._longest(unknown["float32"]) == "unknown: this system does not tell its memory"


def test_the_longest_clip_of_a_gpu_that_is_not_here(monkeypatch, capsys):
    assert cli.main(["doctor", "--device", "h100"]) == 0
    found = re.findall(r"VGGT-1B on h100, \S+ +(\d+) frames of 518 x (\d+) pixels", capsys.readouterr().out)
    frames = {int(height): int(count) for count, height in found}
    assert sorted(frames, reverse=True) == [518, 392, 294]
    assert 1000 < frames[392] < frames[294]
    monkeypatch.setenv("XLA_PYTHON_CLIENT_MEM_FRACTION", "0.9")
    assert memory.room_of_gpu("h100").size == pytest.approx(72e9)
    clips = list(doctor._longest_on("h100"))
    more = {clip["height"]: clip["frames"] for clip in clips if clip["model"].startswith("VGGT-1B")}
    assert all(more[height] > frames[height] for height in frames)
    small, base = (
        next(c["frames"] for c in clips if c["model"].startswith(f"DA3-{size} ")) for size in ("SMALL", "BASE")
    )
    assert small > base > more[294]
    monkeypatch.setenv("XLA_PYTHON_CLIENT_MEM_FRACTION", "2")
    assert cli.main(["doctor", "--device", "h100"]) == 2
    assert "XLA_PYTHON_CLIENT_MEM_FRACTION is '2'" in " ".join(capsys.readouterr().err.split())


def test_the_weights_of_a_loaded_model_are_counted_once(monkeypatch):
    use_gpu(monkeypatch, 4e9, 1e9)
    params = {"on the device": jax.numpy.ones(1000, np.float32), "on the host": np.ones(1000)}
    for held, size in ((params, 3e9 + 4000), (None, 3e9)):
        room = memory.available(held)
        assert room is not None
        assert room.size == size


def test_the_page_clears_the_cache_of_this_library_alone(cache, capsys):
    assert cli.main(["doctor", "--clear-cache"]) == 0
    page = capsys.readouterr().out
    said = "in all; VGGTJAX_CACHE=FOLDER; Longest clip that is run at once; VGGT-1B, bfloat16; installed  vggtjax train"
    for words in (str(cache), "vggtjax doctor --clear-cache", "cleared", *said.split("; ")):
        assert words in page
    assert [path.name for path in cache.iterdir()] == ["mine.safetensors"]
    assert clear_cache() == 0


def test_a_link_in_the_cache_is_removed_and_not_followed(cache, tmp_path):
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / "file").write_bytes(b"mine")
    link = cache / f"l-{'1' * 16}.safetensors"
    link.symlink_to(tmp_path / "kept" / "file")
    assert link in cache_parts()[CONVERTED]
    clear_cache()
    assert (tmp_path / "kept" / "file").exists()

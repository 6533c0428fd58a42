"""What `vggtjax doctor` prints, and the cache that it clears."""

import json
import tomllib
from pathlib import Path

import pytest

from vggtjax.commands import main as cli
from vggtjax.commands.doctor import EXTRAS
from vggtjax.pipeline import memory
from vggtjax.pretrained.embedded import demo_model
from vggtjax.storage.cache import CONVERTED, cache_parts, clear_cache

_NOT_OF_THE_LIBRARY = {"docs", "dev"}


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A cache folder with an entry of every kind, and with files of someone else."""
    monkeypatch.setenv("VGGTJAX_CACHE", str(tmp_path / "cache"))
    for name in ("compiled/a-cache", "lowered/b.bin", "passes/c.npz", f"m-{'0' * 16}.safetensors", "mine.safetensors"):
        path = tmp_path / "cache" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"four")
    return tmp_path / "cache"


def test_facts_as_json(cache, capsys):
    assert cli.main(["doctor", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["versions"]["jax"].count(".") == 2
    assert found["cache"] == {"folder": str(cache), "bytes": 16, "parts": dict.fromkeys(cache_parts(), 4)}
    assert found["devices"][0]["platform"] == "cpu"
    clip = {clip["model"]: clip for clip in found["clips"]}["demo"]
    assert (clip["width"], clip["height"]) == (64, 32)
    if clip["frames"] is not None:  # the system tells its memory
        free = min(room["bytes"] for room in found["memory"]["room"])
        frames = memory.most_frames(demo_model(), 32, 64, free)
        assert clip["frames"] == pytest.approx(frames, rel=0.3)  # the process has changed since


def test_the_page_clears_the_cache_of_this_library_alone(cache, capsys):
    assert cli.main(["doctor", "--clear-cache"]) == 0
    page = capsys.readouterr().out
    for words in ("Longest clip that is run at once", "VGGT-1B, bfloat16", "installed  vggtjax train", "cleared"):
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


def test_every_extra_is_named():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    assert set(EXTRAS) == set(project["optional-dependencies"]) - _NOT_OF_THE_LIBRARY

"""Many clips in one call: all of them, in spite of a broken one, and after an interruption."""

import numpy as np
import pytest
from PIL import Image

from tests.moving_ball import moving_ball
from tests.tiny import tiny_config
from vggtjax import Reconstruction, init_params
from vggtjax.batch import SETTINGS_NAME, reconstruct_many
from vggtjax.checkpoint import Model
from vggtjax.clips.sources import clips_by_name
from vggtjax.errors import ClipError, InputError

pytestmark = pytest.mark.filterwarnings("ignore:the field of view")


@pytest.fixture(scope="module")
def model():
    config = tiny_config()
    return Model(config, init_params(0, config), "tiny")


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    """Six clips of two shapes; the third is corrupt."""
    root = tmp_path_factory.mktemp("clips")
    for number in range(6):
        (root / f"clip{number}").mkdir()
        for i, frame in enumerate((255 * moving_ball(2)).astype(np.uint8)):
            rows = 140 if number % 2 else 70
            Image.fromarray(frame[:rows]).save(root / f"clip{number}/{i}.png")
    (root / "clip2/1.png").write_bytes(b"broken")
    (root / ".hidden").mkdir()
    return root


def test_every_good_clip_is_there_once_and_the_broken_one_is_named(model, clips, tmp_path):
    sources = clips_by_name([str(clips)])
    assert list(sources) == [f"clip{number}" for number in range(6)]
    first = reconstruct_many(model, sources, tmp_path, options={"method": "vggt"})
    done = [next(first) for _ in range(2)]
    first.close()  # as an interruption does
    assert all(outcome.status in ("done", "failed") for outcome in done)
    finished = {path.parent.name: path.stat().st_mtime_ns for path in tmp_path.glob("*/reconstruction.npz")}
    assert finished

    outcomes = {o.name: o for o in reconstruct_many(model, sources, tmp_path, options={"method": "vggt"})}
    assert len(outcomes) == 6
    assert {name for name, outcome in outcomes.items() if outcome.status == "kept"} == set(finished)
    assert outcomes["clip2"].status == "failed"
    assert "1.png" in outcomes["clip2"].reason
    for name, outcome in outcomes.items():
        if name != "clip2":
            result = Reconstruction.load(tmp_path / name)
            assert result.method == "vggt"
            assert outcome.status == "kept" or outcome.frames == 2
    for name, time in finished.items():
        assert (tmp_path / name / "reconstruction.npz").stat().st_mtime_ns == time
    assert not list(tmp_path.rglob(".partial*"))

    with pytest.raises(InputError, match=rf"{SETTINGS_NAME} has other settings than this run"):
        next(reconstruct_many(model, sources, tmp_path, options={"method": "4dvggt-d"}))


def test_results_are_those_of_single_runs(model, clips, tmp_path):
    from vggtjax import load_clip, reconstruct

    sources = {"a": str(clips / "clip0"), "b": str(clips / "clip1")}
    outcomes = list(
        reconstruct_many(model, sources, tmp_path, options={"method": "vggt"}, saving={"resolution": "original"})
    )
    assert [outcome.status for outcome in outcomes] == ["done", "done"]
    for name, source in sources.items():
        alone = reconstruct(model, load_clip(source, size=56, patch=14), method="vggt")
        np.testing.assert_array_equal(Reconstruction.load(tmp_path / name).depth, alone.depth)
        with Image.open(tmp_path / name / "mask/000000.png") as mask, Image.open(f"{source}/0.png") as picture:
            assert mask.size == picture.size


@pytest.mark.parametrize("name", ["", "..", "a/b", "a\n"])
def test_names_that_are_no_folders(model, tmp_path, name):
    with pytest.raises(InputError, match="a clip is named"):
        next(reconstruct_many(model, {name: "x"}, tmp_path))
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"size": 50}, "size is 50"),
        ({"sampling": {"stride": 0}}, "stride is 0"),
        ({"options": {"method": "best"}}, "unknown method 'best'"),
    ],
)
def test_what_is_wrong_for_all_clips_is_said_once(model, clips, tmp_path, wrong, message):
    with pytest.raises(InputError, match=message):
        next(reconstruct_many(model, {"a": str(clips / "clip0")}, tmp_path, **wrong))
    assert not any(tmp_path.iterdir())


def test_what_is_no_clip(clips, tmp_path):
    with pytest.raises(ClipError, match="is no clip and holds none"):
        clips_by_name([str(tmp_path)])
    with pytest.raises(ClipError, match="two clips are named clip0"):
        clips_by_name([str(clips), str(clips / "clip0")])
    with pytest.raises(ClipError, match="no clips"):
        clips_by_name([])

"""Many clips in one call: all of them, in spite of a broken one, and after an interruption."""

import dataclasses
import shutil
import tempfile
from functools import partial
from typing import Any

import jax
import numpy as np
import pytest
from PIL import Image

from tests.shared.moving_ball import moving_ball
from tests.shared.servers import empty_memory, served
from tests.shared.tiny import tiny_model
from tests.shared.videos import write_video
from vggtjax import Reconstruction
from vggtjax.clips.sources import clips_by_name
from vggtjax.errors import ClipError, InputError, OutputError
from vggtjax.interface.commands import main as cli
from vggtjax.network.checkpoint import save_model
from vggtjax.pipeline.batch.destination import PAGE_NAME, SETTINGS_NAME
from vggtjax.pipeline.batch.many import reconstruct_many
from vggtjax.pipeline.batch.recipe import CHANGED, ClipOutcome
from vggtjax.results.archive import ARCHIVE_NAME

pytestmark = pytest.mark.filterwarnings("ignore:the field of view")


@pytest.fixture(scope="module")
def model():
    return tiny_model()


def write_clip(folder, frames, rows):
    folder.mkdir(parents=True)
    for i, frame in enumerate((255 * moving_ball(frames)).astype(np.uint8)):
        Image.fromarray(frame[:rows]).save(folder / f"{i}.png")


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    """Six clips of two shapes; the third is corrupt."""
    root = tmp_path_factory.mktemp("clips")
    for number in range(6):
        write_clip(root / f"clip{number}", frames=2, rows=140 if number % 2 else 70)
    (root / "clip2/1.png").write_bytes(b"broken")
    (root / ".hidden").mkdir()
    return root


def test_every_good_clip_is_there_once_and_the_broken_one_is_named(model, clips, tmp_path):
    sources = clips_by_name([str(clips)])
    assert list(sources) == [f"clip{number}" for number in range(6)]
    run = partial(reconstruct_many, model, sources, tmp_path, only=("depth",))
    first = run(method="vggt")
    done = [next(first) for _ in range(2)]
    first.close()  # as an interruption does
    assert all(outcome.status in ("done", "failed") for outcome in done)
    finished = {path.parent.name: path.stat().st_mtime_ns for path in tmp_path.glob("*/reconstruction.npz")}
    assert finished

    outcomes = {outcome.name: outcome for outcome in run(method="vggt")}
    assert len(outcomes) == 6
    assert {name for name, outcome in outcomes.items() if outcome.status == "kept"} == set(finished)
    assert outcomes["clip2"].status == "failed"
    assert "1.png" in outcomes["clip2"].reason
    for name, outcome in outcomes.items():
        if name != "clip2":
            result = Reconstruction.load(tmp_path / name)
            assert result.method == "vggt"
            assert outcome.status == "kept" or outcome.frames == 2
    for name, written in finished.items():
        assert (tmp_path / name / "reconstruction.npz").stat().st_mtime_ns == written
    assert not list(tmp_path.rglob(".*partial*"))

    with pytest.raises(InputError, match=rf"{SETTINGS_NAME} has other settings than this run"):
        next(run(method="4dvggt-d"))


def test_a_clip_that_has_changed_since_is_done_again(model, tmp_path):
    """By its arrays, or by the names, sizes and ends of its files; a copy elsewhere is the same clip."""
    frames = (255 * moving_ball(2)[:, :70]).astype(np.uint8)
    write_clip(tmp_path / "a", frames=2, rows=70)

    def run(folder, array):
        made = reconstruct_many(model, {"f": folder, "m": array}, tmp_path / "out", method="vggt", only=("depth",))
        return {outcome.name: (outcome.status, outcome.reason) for outcome in made}

    assert set(run(str(tmp_path / "a"), frames).values()) == {("done", "")}
    copy = shutil.copytree(tmp_path / "a", tmp_path / "b", copy_function=shutil.copyfile)
    assert set(run(str(copy), frames.copy()).values()) == {("kept", "")}
    before = Reconstruction.load(tmp_path / "out/m").images
    Image.fromarray(frames[1, :, ::-1]).save(copy / "1.png")
    assert set(run(str(copy), frames[::-1]).values()) == {("done", CHANGED)}
    np.testing.assert_array_equal(Reconstruction.load(tmp_path / "out/m").images, before[::-1])
    shutil.rmtree(copy)
    assert run(str(copy), frames[::-1])["f"] == ("kept", "")  # the clip is gone, its result is not


def test_progress_counts_clips(model, tmp_path):
    root = tmp_path / "clips"
    write_clip(root / "a", 2, 70)
    write_video(root / "b.mp4", range(0, 300, 100), size=(140, 70))
    write_clip(root / "c", 8, 70)
    (root / "c/7.png").write_bytes(b"broken")
    seen = []
    sources = clips_by_name([str(root)]) | {"nothing": str(tmp_path / "none")}
    run = partial(reconstruct_many, method="vggt", only=(), progress=lambda *count: seen.append(count))
    outcomes = run(model, sources, tmp_path / "out")
    assert sum(outcome.status == "failed" for outcome in outcomes) == 2
    assert seen[0] == (0, 4)
    assert seen[-1] == (2, 2)
    assert len(seen) == 5


def test_results_are_those_of_single_runs(model, clips, tmp_path):
    from vggtjax import load_clip, reconstruct

    sources = {"a": str(clips / "clip0"), "b": str(clips / "clip1")}
    outcomes = list(reconstruct_many(model, sources, tmp_path, method="vggt", resolution="original"))
    assert [outcome.status for outcome in outcomes] == ["done", "done"]
    for name, source in sources.items():
        alone = reconstruct(model, load_clip(source, size=56, patch=14), method="vggt")
        many = Reconstruction.load(tmp_path / name)
        np.testing.assert_array_equal(many.depth, alone.depth)
        assert "known" not in many.settings
        with Image.open(tmp_path / name / "depth/000000.png") as depth, Image.open(f"{source}/0.png") as picture:
            assert depth.size == picture.size
        assert not (tmp_path / name / "mask").exists()  # the method makes none


def test_clips_from_urls_and_results_at_urls(model, clips, tmp_path, monkeypatch):
    """A list on a web server names folders there and one in memory; the results are those of local files."""
    run = partial(reconstruct_many, model, method="vggt", resolution="original", only=("depth",))
    list(run(clips_by_name([str(clips)]), tmp_path / "local"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    with empty_memory() as memory, served(clips) as url:
        memory.put(str(clips / "clip5"), "/videos/clip5", recursive=True)
        lines = ["source", *(f"clip{number}/" for number in range(5)), "memory://videos/clip5", "gone.mp4"]
        (clips / "all.csv").write_text("\n".join(lines))
        sources = clips_by_name([f"{url}/all.csv"])
        (clips / "all.csv").unlink()
        assert list(sources) == [*(f"clip{number}" for number in range(6)), "gone"]
        assert list(clips_by_name(["memory://videos", f"{url}/clip1/"])) == ["clip5", "clip1"]
        outcomes = {outcome.name: outcome for outcome in run(sources, "memory://results")}
        assert {name for name, outcome in outcomes.items() if outcome.status != "done"} == {"clip2", "gone"}
        assert "1.png" in outcomes["clip2"].reason
        assert "there is nothing at http://127.0.0.1" in outcomes["gone"].reason
        assert not list((tmp_path / "temporary").iterdir())
        memory.get("/results", str(tmp_path / "copy"), recursive=True)
        files = {
            path.relative_to(tmp_path / "local"): path.read_bytes()
            for path in (tmp_path / "local").rglob("*")
            if path.is_file() and path.name != PAGE_NAME
        }
        assert len(files) > 10
        assert {p.relative_to(tmp_path / "copy"): p.read_bytes() for p in (tmp_path / "copy").rglob("*.*")} == files

        memory.rm(f"/results/clip0/{ARCHIVE_NAME}")  # as an upload that was killed leaves it
        again = {outcome.name: outcome.status for outcome in run(sources, "memory://results")}
        assert {name for name, status in again.items() if status == "kept"} == {"clip1", "clip3", "clip4", "clip5"}
        assert again["clip0"] == "done"
        with pytest.raises(InputError, match=r"memory://results/batch.json has other settings"):
            next(run(sources, "memory://results", pad_frames=True))
    with pytest.raises(InputError, match=r"https://h/results can be read, not written"):
        next(run({}, "https://h/results"))


def test_two_batches_on_one_folder(model, clips, tmp_path, monkeypatch):
    sources = {name: str(clips / name) for name in ("clip0", "clip1")}
    run = partial(reconstruct_many, model, sources, tmp_path, method="vggt", only=())
    first = run()
    assert next(first).status == "done"
    with pytest.raises(OutputError, match="another run is writing a batch"):
        next(run())
    assert [outcome.status for outcome in first] == ["done"]
    asked = []
    monkeypatch.setattr("vggtjax.pipeline.batch.many.has_changed", lambda place, name, source: asked.append(name))
    again = run()
    assert next(again) == ClipOutcome("clip0", "kept")
    assert asked == ["clip0"]  # the other sources are not read before it is told
    assert next(again) == ClipOutcome("clip1", "kept")


def test_shards_at_once_are_one_batch(model, clips, tmp_path):
    sources = clips_by_name([str(clips)])
    run, out = partial(reconstruct_many, model, sources, method="vggt", only=()), tmp_path / "shards"
    list(run(tmp_path / "one"))
    shards = [run(out, shard=f"{k}/3") for k in (1, 2, 3)]
    outcomes = [next(shard) for shard in shards]
    for number in (1, 3):
        with pytest.raises(OutputError, match=f"another run is writing shard {number}/3 of the batch"):
            next(run(out, shard=f"{number}/3"))
    with pytest.raises(OutputError, match="another run is writing shard 1/3 of the batch"):
        next(run(out))
    outcomes += [outcome for shard in shards for outcome in shard]
    assert sorted(outcome.name for outcome in outcomes) == list(sources)
    assert [outcome.name for outcome in outcomes if outcome.status != "done"] == ["clip2"]
    assert not (out / PAGE_NAME).exists()
    again = list(run(out))
    assert {outcome.name for outcome in again if outcome.status == "kept"} == set(sources) - {"clip2"}
    assert {path.name for path in out.iterdir()} == {path.name for path in (tmp_path / "one").iterdir()}
    for path in (tmp_path / "one").glob(f"*/{ARCHIVE_NAME}"):
        assert (out / path.relative_to(tmp_path / "one")).read_bytes() == path.read_bytes()


@pytest.mark.parametrize("shard", ["3", "0/3", "4/3", "1/99999999"])
def test_shards_that_are_none_are_refused(model, clips, tmp_path, shard):
    with pytest.raises(InputError, match="expected K/N with K from 1 to N, such as 3/16"):
        next(reconstruct_many(model, {"a": str(clips / "clip0")}, tmp_path / "out", shard=shard))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["..", "a/b"])
def test_a_name_that_is_no_folder_fails_alone(model, clips, tmp_path, name):
    sources = {name: str(clips / "clip0"), "b": str(clips / "clip2")}  # clip2 is corrupt: it fails in its turn
    odd, other = reconstruct_many(model, sources, tmp_path / "out", method="vggt")
    assert (odd.name, odd.status) == (name, "failed")
    assert "a clip is named" in odd.reason
    assert "1.png" in other.reason
    assert {path.name for path in (tmp_path / "out").iterdir()} == {SETTINGS_NAME, "index.html"}


def test_only_settings_that_change_results_are_compared_and_they_are_named(model, tmp_path):
    run = partial(reconstruct_many, model, {}, tmp_path)
    assert list(run()) == []
    assert list(run(gram="cosine", suppress="zero", refine_mask=False, stride=1)) == []
    with pytest.raises(InputError, match=r"\(gram 'cosine', now 'dot'; mask_pairs 5, now 3\)"):
        list(run(gram="dot", mask_pairs=3))


def test_a_batch_knows_a_model_by_its_weights(model, tmp_path):
    assert list(reconstruct_many(model, {}, tmp_path)) == []
    other = dataclasses.replace(model, params=jax.tree.map(lambda leaf: leaf + 1, model.params))
    with pytest.raises(InputError, match=r"has other settings than this run \(model"):
        list(reconstruct_many(other, {}, tmp_path))


def test_masks_by_clip(model, clips, tmp_path):
    sources = {name: str(clips / name) for name in ("clip0", "clip1", "clip3", "clip4")}
    masks = np.zeros((2, 70, 140), bool)
    masks[:, :30, :30] = True
    for number, mask in enumerate(masks):
        folder = tmp_path / "masks/clip4"
        folder.mkdir(parents=True, exist_ok=True)
        Image.fromarray(mask).save(folder / f"{number}.png")
    by_clip = {"clip0": masks, "clip1": False, "clip4": tmp_path / "masks/clip4"}
    run: Any = partial(reconstruct_many, model, sources, tmp_path / "out", only=("depth",))
    assert [outcome.status for outcome in run(masks=by_clip)] == ["done"] * 4
    made = {name: Reconstruction.load(tmp_path / "out" / name) for name in sources}
    assert [made[name].settings["masks"] for name in sources] == ["given", "given", "mined", "given"]
    assert (made["clip0"].dynamic_mask == made["clip4"].dynamic_mask).all()
    assert made["clip0"].dynamic_mask.any()
    assert not made["clip1"].dynamic_mask.any()
    with pytest.raises(InputError, match=r"has other settings than this run \(masks"):
        list(run(masks=by_clip | {"clip0": ~masks}))
    with pytest.raises(InputError, match="masks has 'clip9', which is no clip of the batch"):
        list(run(masks={"clip9": False}))
    with pytest.raises(InputError, match="expected a folder with a folder of pictures named like a clip"):
        list(run(masks=tmp_path / "out" / "clip0"))
    with pytest.raises(InputError, match="masks is of type ndarray; expected masks by the name of the clip"):
        list(run(masks=masks))
    with pytest.raises(InputError, match="fusion is a function, and a later run could not tell"):
        list(run(fusion=lambda seen: (seen.depth1, seen.depth2)))
    with pytest.raises(InputError, match="given masks are not mined"):
        list(run(masks=by_clip, threshold="otsu"))
    words = [
        "batch",
        *sources.values(),
        "--masks",
        str(tmp_path / "masks"),
        "--only",
        "depth",
        "--out",
        str(tmp_path / "b"),
    ]
    words += ["--model", str(save_model(tmp_path / "m.safetensors", model.params, model.config))]
    assert cli.main(words) == 0
    again = Reconstruction.load(tmp_path / "b/clip4")
    assert (again.dynamic_mask == made["clip4"].dynamic_mask).all()
    assert again.settings["consistent_depth"] is True  # the command's default
    Image.fromarray(~masks[0]).save(tmp_path / "masks/clip4/0.png")
    assert cli.main(words) == 2


def test_what_is_wrong_for_all_clips_is_said_once(model, clips, tmp_path):
    with pytest.raises(InputError, match="size is 50"):
        next(reconstruct_many(model, {"a": str(clips / "clip0")}, tmp_path, size=50))
    with pytest.raises(InputError, match="devices is 0"):
        next(reconstruct_many(model, {"a": str(clips / "clip0")}, tmp_path, known=None, devices=0))
    with pytest.raises(TypeError, match="sampling is of type dict; expected Sampling"):
        next(reconstruct_many(model, {"a": str(clips / "clip0")}, tmp_path, sampling={"fps": 2}))
    assert not any(tmp_path.iterdir())


def test_what_is_no_clip(clips, tmp_path):
    with pytest.raises(ClipError, match="is not a clip and holds no clips"):
        clips_by_name([str(tmp_path)])
    with pytest.raises(ClipError, match="two clips are named clip0"):
        clips_by_name([str(clips), str(clips / "clip0")])
    with pytest.raises(ClipError, match="no clips"):
        clips_by_name([])

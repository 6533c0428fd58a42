"""Many clips in one call: all of them, in spite of a broken one, and after an interruption."""

import os
import subprocess
import sys
import tempfile
import time
from functools import partial

import jax
import numpy as np
import pytest
from PIL import Image

from tests.moving_ball import moving_ball
from tests.servers import empty_memory, served
from tests.tiny import tiny_model
from vggtjax import Reconstruction
from vggtjax.checkpoint import Model, save_model
from vggtjax.clips.sources import clips_by_name
from vggtjax.commands.batch import _Clock
from vggtjax.errors import ClipError, InputError, OutputError
from vggtjax.pipeline.batch import reconstruct_many
from vggtjax.pipeline.destination import PAGE_NAME, SETTINGS_NAME
from vggtjax.results.archive import ARCHIVE_NAME, is_result

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
    for name, written in finished.items():
        assert (tmp_path / name / "reconstruction.npz").stat().st_mtime_ns == written
    assert not list(tmp_path.rglob(".*partial*"))

    with pytest.raises(InputError, match=rf"{SETTINGS_NAME} has other settings than this run"):
        next(reconstruct_many(model, sources, tmp_path, options={"method": "4dvggt-d"}))


def write_video(path, frames, rows):
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.height, stream.width = rows, moving_ball(1).shape[2]
        stream.pix_fmt = "yuv420p"
        for picture in (255 * moving_ball(frames)).astype(np.uint8):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture[:rows], format="rgb24")))
        container.mux(stream.encode())


@pytest.mark.proof
def test_the_command_goes_on_after_it_was_killed(model, tmp_path):
    """Twelve clips of three shapes, two of them videos and one corrupt, killed once four are done."""
    root, out, visible = tmp_path / "clips", tmp_path / "out", f"[!.]*/{ARCHIVE_NAME}"
    lengths = {}
    for number in range(12):
        name, frames, rows = f"clip{number:02}", *((2, 70), (3, 70), (2, 140))[number % 3]
        lengths[name] = frames
        if number in (5, 10):
            write_video(root / f"{name}.mp4", frames, rows)
        else:
            write_clip(root / name, frames, rows)
    (root / "clip03/1.png").write_bytes((root / "clip03/1.png").read_bytes()[:100])
    save_model(tmp_path / "tiny.safetensors", model.params, model.config)
    command = [sys.executable, "-m", "vggtjax", "batch", str(root), "--out", str(out), "--model"]
    command += [str(tmp_path / "tiny.safetensors"), "--method", "pose-decoupling"]
    environment = os.environ | {"VGGTJAX_CACHE": str(tmp_path / "cache"), "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}

    with subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as running:
        while len(list(out.glob(visible))) < 4 and running.poll() is None:
            time.sleep(0.01)
        running.kill()
        _, said = running.communicate()
    assert running.returncode < 0, said.decode()  # by the signal
    finished = {path.parent.name: path.stat().st_mtime_ns for path in out.glob(visible)}
    assert 4 <= len(finished) < 11
    folders = {path.name for path in out.iterdir() if path.is_dir() and not path.name.startswith(".")}
    assert folders == set(finished)  # what can be seen is whole
    for name in finished:
        assert is_result(out / name / ARCHIVE_NAME)
        assert len(Reconstruction.load(out / name).depth) == lengths[name]

    again = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert again.returncode == 0, again.stderr
    results = {path.parent.name: path.stat().st_mtime_ns for path in out.rglob(ARCHIVE_NAME)}
    assert set(results) == set(lengths) - {"clip03"}
    assert {path.name for path in out.iterdir()} == {
        *results,
        SETTINGS_NAME,
        PAGE_NAME,
    }  # once each, and nothing left over
    for name in results:
        assert len(Reconstruction.load(out / name).depth) == lengths[name]
        assert (out / name / "scene.glb").stat().st_size > 1000
    assert {name: results[name] for name in finished} == finished
    table = dict(line.split(maxsplit=1) for line in again.stdout.splitlines()[:4])
    assert table == {"clips": "12", "done": f"{11 - len(finished)}", "kept": f"{len(finished)}", "failed": "1"}
    assert "clip03 failed: " in again.stdout
    assert "1.png" in again.stdout.partition("clip03 failed: ")[2].splitlines()[0]
    for name in set(results) - set(finished):
        assert f"{name}: done" in again.stderr
    assert all(f"{name}: kept" in again.stderr for name in finished)


def test_what_a_killed_run_has_left_is_cleared_away(model, clips, tmp_path):
    half_written = tmp_path / ".vggtjax-partial-0123456789abcdef"
    (half_written / "clip0/depth").mkdir(parents=True)
    (half_written / "clip0/depth/old.npy").write_bytes(b"half")
    os.utime(half_written, (0, 0))
    sources = {"clip0": str(clips / "clip0")}
    assert [outcome.status for outcome in reconstruct_many(model, sources, tmp_path, options={"method": "vggt"})] == [
        "done"
    ]
    assert {path.name for path in tmp_path.iterdir()} == {"clip0", SETTINGS_NAME, PAGE_NAME}
    assert not list(tmp_path.rglob("old.npy"))


def test_a_folder_that_is_there_keeps_its_files(model, clips, tmp_path):
    (tmp_path / "clip0").mkdir()
    (tmp_path / "clip0/mine.txt").write_text("mine")
    (tmp_path / "clip1/depth").mkdir(parents=True)
    sources = {name: str(clips / name) for name in ("clip0", "clip1")}
    outcomes = list(reconstruct_many(model, sources, tmp_path, options={"method": "vggt"}))
    assert {outcome.name: outcome.status for outcome in outcomes} == {"clip0": "done", "clip1": "failed"}
    assert (tmp_path / "clip0/mine.txt").read_text() == "mine"
    assert is_result(tmp_path / "clip0" / ARCHIVE_NAME)
    assert [path.name for path in (tmp_path / "clip1").iterdir()] == ["depth"]


def test_clips_of_one_shape_share_a_compilation(model, tmp_path):
    for number, frames in enumerate([5, 7, 5, 7, 5]):  # lengths that no other test compiles
        write_clip(tmp_path / f"clips/{number}", frames, 70)
    compiled, counts = [], []

    def listen(event, duration_secs, **_):
        if event.endswith("backend_compile_duration"):
            compiled.append(event)

    def progress(done, total):
        counts.append(len(compiled))

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        sources = clips_by_name([str(tmp_path / "clips")])
        outcomes = reconstruct_many(model, sources, tmp_path / "out", options={"method": "vggt"}, progress=progress)
        assert {outcome.status for outcome in outcomes} == {"done"}
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert [new > 0 for new in np.diff(counts)] == [True, True, False, False, False]


def test_progress_counts_frames(model, tmp_path):
    """A video counts as the mean of the others until it is read, and a clip that fails not at all."""
    root = tmp_path / "clips"
    write_clip(root / "a", 2, 70)
    write_video(root / "b.mp4", 3, 70)
    write_clip(root / "c", 8, 70)
    (root / "c/7.png").write_bytes(b"broken")
    write_clip(root / "d", 2, 70)
    seen = []
    sources = clips_by_name([str(root)]) | {"nothing": str(tmp_path / "none")}
    outcomes = reconstruct_many(
        model, sources, tmp_path / "out", options={"method": "vggt"}, progress=lambda *count: seen.append(count)
    )
    assert sum(outcome.status == "failed" for outcome in outcomes) == 2
    assert seen == [(0, 16), (2, 16), (5, 15), (5, 7), (7, 7), (7, 7)]


def test_the_time_that_is_left_goes_by_frames(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    shown = []
    clock = _Clock(lambda *count: shown.append(count))
    clock.progress(0, 40)
    assert clock.left() == ""
    now[0] += 100
    clock.progress(1, 40)
    assert clock.left() == ", 1:05:00 left"
    clock.progress(40, 40)
    assert clock.left() == ""
    assert shown == [(0, 40), (1, 40), (40, 40)]


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


def test_results_of_other_weights_are_not_kept(model, clips, tmp_path):
    sources = {"clip0": str(clips / "clip0")}
    assert [outcome.status for outcome in reconstruct_many(model, sources, tmp_path, method="vggt")] == ["done"]
    retrained = Model(model.config, jax.tree.map(lambda leaf: leaf + 1e-3, model.params), model.name)
    with pytest.raises(InputError, match="other settings than this run"):
        next(reconstruct_many(retrained, sources, tmp_path, method="vggt"))


def test_clips_from_urls_and_results_at_urls(model, clips, tmp_path, monkeypatch):
    """A list on a web server names folders there and one in memory; the results are those of local files."""
    run = partial(reconstruct_many, model, method="vggt", saving={"resolution": "original", "only": ["depth"]})
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


def test_two_batches_on_one_folder(model, clips, tmp_path):
    sources = {name: str(clips / name) for name in ("clip0", "clip1")}
    first = reconstruct_many(model, sources, tmp_path, method="vggt")
    assert next(first).status == "done"
    with pytest.raises(OutputError, match="another run is writing a batch"):
        next(reconstruct_many(model, sources, tmp_path, method="vggt"))
    assert [outcome.status for outcome in first] == ["done"]
    again = [outcome.status for outcome in reconstruct_many(model, sources, tmp_path, method="vggt")]
    assert again == ["kept", "kept"]


def test_shards_at_once_are_one_batch(model, clips, tmp_path):
    sources = clips_by_name([str(clips)])
    list(reconstruct_many(model, sources, tmp_path / "one", method="vggt"))
    out = tmp_path / "shards"
    shards = [reconstruct_many(model, sources, out, method="vggt", shard=f"{k}/3") for k in (1, 2, 3)]
    outcomes = [next(shard) for shard in shards]
    for number in (1, 3):
        with pytest.raises(OutputError, match=f"another run is writing shard {number}/3 of the batch"):
            next(reconstruct_many(model, sources, out, method="vggt", shard=f"{number}/3"))
    with pytest.raises(OutputError, match="another run is writing shard 1/3 of the batch"):
        next(reconstruct_many(model, sources, out, method="vggt"))
    outcomes += [outcome for shard in shards for outcome in shard]
    assert sorted(outcome.name for outcome in outcomes) == list(sources)
    assert [outcome.name for outcome in outcomes if outcome.status != "done"] == ["clip2"]
    assert not (out / PAGE_NAME).exists()
    again = list(reconstruct_many(model, sources, out, method="vggt"))
    assert {outcome.name for outcome in again if outcome.status == "kept"} == set(sources) - {"clip2"}
    assert {path.name for path in out.iterdir()} == {path.name for path in (tmp_path / "one").iterdir()}
    for path in (tmp_path / "one").glob(f"*/{ARCHIVE_NAME}"):
        assert (out / path.relative_to(tmp_path / "one")).read_bytes() == path.read_bytes()


@pytest.mark.parametrize("shard", ["", "3", "0/3", "4/3", "-1/3", "1/0", "a/b", "1/99999999"])
def test_shards_that_are_none_are_refused(model, clips, tmp_path, shard):
    with pytest.raises(InputError, match="expected K/N with K from 1 to N, such as 3/16"):
        next(reconstruct_many(model, {"a": str(clips / "clip0")}, tmp_path / "out", shard=shard))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["", "..", "a/b", "a\n"])
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
    assert list(run(gram="cosine", suppress="zero", refine_mask=False, sampling={"stride": 1})) == []
    with pytest.raises(InputError, match=r"\(gram 'cosine', now 'dot'; mask_pairs 5, now 3\)"):
        list(run(gram="dot", mask_pairs=3))


def test_unknown_options_are_named(model, tmp_path):
    for name in ("keep_passes", "masks"):
        with pytest.raises(TypeError, match=f"no option is named {name}; expected .*mask_pairs"):
            next(reconstruct_many(model, {}, tmp_path, options={name: True}))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"size": 50}, "size is 50"),
        ({"sampling": {"stride": 0}}, "stride is 0"),
        ({"options": {"method": "best"}}, "method is 'best'; expected one of vggt, vggt4d"),
    ],
)
def test_what_is_wrong_for_all_clips_is_said_once(model, clips, tmp_path, wrong, message):
    with pytest.raises(InputError, match=message):
        next(reconstruct_many(model, {"a": str(clips / "clip0")}, tmp_path, **wrong))
    assert not any(tmp_path.iterdir())


def test_what_is_no_clip(clips, tmp_path):
    with pytest.raises(ClipError, match="is not a clip and holds no clips"):
        clips_by_name([str(tmp_path)])
    with pytest.raises(ClipError, match="'nope' does not exist"):
        clips_by_name(["nope"])
    with pytest.raises(ClipError, match="two clips are named clip0"):
        clips_by_name([str(clips), str(clips / "clip0")])
    with pytest.raises(ClipError, match="no clips"):
        clips_by_name([])

import dataclasses
import json
import shutil

import numpy as np
import pytest

from vggtjax.errors import InputError
from vggtjax.interface.commands import main as cli
from vggtjax.interface.commands.fit_fusion import aligned
from vggtjax.method.fusion.family import paper_rule
from vggtjax.method.fusion.file import load_fusion, save_fusion
from vggtjax.research.evaluation.datasets.sequence import LabelledSequence
from vggtjax.research.learning.ablation import CHOSEN
from vggtjax.research.learning.clip_passes import ClipPasses, fit_clips, kept_passes, observations, sequence_digest
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.storage.arrays import write_arrays


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


pytestmark = pytest.mark.filterwarnings("ignore:the field of view")
ARGUMENTS = ["--family", "scale", "scale+correlation", "paper", "--seeds", 2, "--steps", 20, "--pixels", 300]


def run(*arguments) -> int:
    return cli.main([str(a) for a in arguments])


@pytest.fixture(scope="module")
def fitted(sequences, cache, tiny_demo_file, tmp_path_factory):
    out = tmp_path_factory.mktemp("fits")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VGGTJAX_CACHE", str(cache))
        code = run("fit-fusion", "--out", out, "--data", f"plain={sequences}", "--model", tiny_demo_file, *ARGUMENTS)
    assert code == 0
    return out


def test_all_of_it(fitted, cache):
    numbers = json.loads((fitted / "fit.json").read_text())
    rules = ["pass 1 alone", "pass 2 alone", "hard replacement", "paper", "scale", "scale+correlation", CHOSEN]
    assert list(numbers["table"]) == rules
    assert [(o["rule"], o["seed"]) for o in numbers["outcomes"]] == [(r, s) for s in (0, 1) for r in rules]
    for seed in (0, 1):  # the family is chosen without the clips of the scores
        own = {o["rule"]: o for o in numbers["outcomes"] if o["seed"] == seed}
        best = min(("scale", "scale+correlation"), key=lambda rule: own[rule]["stopping"]["nll"])
        assert own[CHOSEN]["metrics"] == own[best]["metrics"]
    assert numbers["chosen"] in ("scale", "scale+correlation")
    assert all(np.isfinite(o["metrics"]["nll"]) for o in numbers["outcomes"])
    table = {rule: {name: mean for name, (mean, _) in row.items()} for rule, row in numbers["table"].items()}
    assert table["scale"]["nll"] < table["paper"]["nll"]  # the confidence of the demo model is not a precision
    names = ("fusion.safetensors", "table.md", "scores.png", "precision.png", "calibration.png", "losses.png")
    assert all((fitted / name).is_file() for name in names)
    assert (fitted / "table.md").read_text().count("\n") == 2 + len(rules)
    assert np.asarray(load_fusion(fitted / "families" / "scale.safetensors")["scale"]).any()
    assert len(list((cache / "passes").iterdir())) == 4


@pytest.mark.usefixtures("no_plots")
def test_passes_and_fits_are_kept(fitted, sequences, cache, tiny_demo_file, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("VGGTJAX_CACHE", str(cache))
    for made_anew in ("clip_passes.reconstruct", "fit._advanced"):
        monkeypatch.setattr(f"vggtjax.research.learning.{made_anew}", None)  # would fail
    out = shutil.copytree(fitted, tmp_path / "again")
    (out / "fit.json").unlink()
    assert run("fit-fusion", "--out", out, "--data", f"plain={sequences}", "--model", tiny_demo_file, *ARGUMENTS) == 0
    assert (out / "fit.json").read_text() == (fitted / "fit.json").read_text()
    assert "against paper" in capsys.readouterr().out


@pytest.mark.usefixtures("no_plots")
def test_the_file_is_what_reconstruct_batch_and_evaluate_fuse_by(
    fitted, sequences, tiny_demo_file, tmp_path, capsys, caplog
):
    frames = sequences / "clip0" / "rgb"
    (tmp_path / "link.safetensors").symlink_to(tiny_demo_file)
    model = ["--model", tmp_path / "link.safetensors"]
    common = ["--only", "cameras", "--no-consistent-depth", *model]
    results = {}
    save_fusion(tmp_path / "paper.safetensors", paper_rule())
    files = {"none": [], "paper": ["--fusion", tmp_path / "paper.safetensors"]}
    files["fitted"] = ["--fusion", fitted / "families" / "scale.safetensors"]
    for name, option in files.items():
        assert run("reconstruct", frames, "--out", tmp_path / name, *common, *option) == 0
        results[name] = Reconstruction.load(tmp_path / name)
    assert np.allclose(results["paper"].depth, results["none"].depth, rtol=2e-6)
    assert np.allclose(results["paper"].depth_confidence, results["none"].depth_confidence, rtol=1e-5)
    assert not np.allclose(results["fitted"].depth_confidence, results["none"].depth_confidence, rtol=1e-2)
    assert results["fitted"].settings["fusion"] != results["paper"].settings["fusion"]
    assert run("batch", frames, "--out", tmp_path / "batch", *common, *files["fitted"]) == 0
    batched = Reconstruction.load(tmp_path / "batch" / "rgb")
    assert np.allclose(batched.depth_confidence, results["fitted"].depth_confidence, rtol=1e-4)
    score = ["evaluate", "plain", sequences, "--out", tmp_path / "scores", "--sequences", "clip0", *model]
    assert run(*score, "--methods", "4dvggt-d", *files["fitted"]) == 0
    assert "was fitted with" not in caplog.text  # the same model by another path
    capsys.readouterr()
    assert run("reconstruct", frames, "--out", tmp_path / "x", "--method", "vggt", *common, *files["fitted"]) == 2
    assert "method 'vggt' does not fuse; expected 4dvggt-d" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--data", "scenes"], "expected generated=N or DATASET=FOLDER"),
        (["--data", "generated=2"], "2 clips with a true depth; expected at least three"),
        (["--data", "generated=3", "plain={tmp}"], "no model is named; give --model"),
    ],
)
def test_bad_input_is_one_sentence(arguments, sentence, tmp_path, capsys):
    (tmp_path / "clip" / "rgb").mkdir(parents=True)
    assert run("fit-fusion", "--out", tmp_path / "out", *(text.format(tmp=tmp_path) for text in arguments)) == 2
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def clip_of(frames: int, size: int, seed: int) -> ClipPasses:
    generator = np.random.default_rng(seed)
    maps = [generator.uniform(1, 3, (frames, size, size)).astype(np.float32) for _ in range(5)]
    return ClipPasses(
        *maps[:4],
        saliency=generator.random((frames, size // 14, size // 14)).astype(np.float32),
        dynamic_mask=maps[0] > 2.5,
        images=generator.integers(0, 256, (frames, size, size, 3), dtype=np.uint8),
        camera_from_world=np.tile(np.eye(3, 4, dtype=np.float32), (frames, 1, 1)),
        intrinsics=np.tile(np.eye(3, dtype=np.float32), (frames, 1, 1)),
        truth=np.where(maps[4] > 1.5, maps[4], 0),
        true_dynamic=maps[0] > 2.6,
    )


def test_clips_of_several_sizes_are_stacked():
    clips = [clip_of(2, 28, 0), clip_of(3, 42, 1)]
    seen = [observations(clip) for clip in clips]
    scattered = fit_clips(clips, seen, pixels=100)
    assert scattered.truth.shape == (2, 1, 1, 100)
    assert (np.asarray(scattered.truth) > 0).all()
    for own, clip in zip(np.asarray(scattered.seen.depth1), clips, strict=True):
        assert np.isin(own.ravel(), clip.depth1).all()
    whole = fit_clips(clips, seen, frames=3)
    assert whole.truth.shape == (2, 3, 42, 42)
    assert np.array_equal(np.asarray(whole.truth)[0, :2, :28, :28], clips[0].truth)
    assert not np.asarray(whole.truth)[0, 2].any()  # filled up with what is not known
    assert whole.view is None  # frames of other sizes cannot be compared
    assert fit_clips([clips[0]] * 2, [seen[0]] * 2).view is not None
    with pytest.raises(InputError, match="no pixel with a true depth"):
        fit_clips([clips[0]._replace(truth=np.zeros((2, 28, 28), np.float32))], seen[:1], pixels=10)


def test_aligned_clips_have_depth_and_cameras_of_one_unit():
    clip = clip_of(3, 28, 0)._replace(camera_from_world=np.ones((3, 3, 4), np.float32))
    clip = aligned(clip._replace(depth2=clip.depth1 / 2))
    assert np.allclose(clip.depth2, clip.depth1)
    assert clip.camera_from_world[0].tolist() == [[1, 1, 1, 2]] * 3


def test_every_frame_of_the_truth_is_in_the_key(tmp_path):
    (tmp_path / "a.png").touch()
    depth = np.ones((7, 4, 6), np.float32)
    sequence = LabelledSequence("a", (tmp_path / "a.png",) * 7, depth.__getitem__)
    digests = [sequence_digest(sequence)]
    depth[1, 2, 3] = 2  # a frame that `evaluation.run.fingerprint` does not read
    digests += [sequence_digest(sequence), sequence_digest(dataclasses.replace(sequence, mask=depth.__getitem__))]
    assert len(set(digests)) == 3


def test_kept_passes_are_made_anew_where_the_file_is_damaged(tmp_path):
    clip, calls = clip_of(2, 28, 0), []

    def make() -> ClipPasses:
        calls.append(1)
        return clip

    for _ in range(2):
        assert np.array_equal(kept_passes({"a": 1}, make, tmp_path).depth1, clip.depth1)
    assert len(calls) == 1
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    path.write_bytes(whole[:200])
    kept_passes({"a": 1}, make, tmp_path)
    write_arrays(path, {"depth1": clip.depth1})
    kept_passes({"a": 1}, make, tmp_path)
    kept_passes({"a": 2}, make, tmp_path)
    assert len(calls) == 4

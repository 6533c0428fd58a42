import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from safetensors.numpy import save_file

from tests.shared.command import refusal, run
from tests.shared.make_checkpoint import make_checkpoint
from tests.shared.room import make_room
from tests.shared.seeded import seeded_state_dict
from vggtjax import Reconstruction, __main__, load_model
from vggtjax.clips.truth import Truth
from vggtjax.interface.commands import main as cli
from vggtjax.pipeline.pretrained import embedded
from vggtjax.pipeline.refinement.pixel_mask import SOURCE
from vggtjax.research.calibration.export import FORMAT

pytestmark = [pytest.mark.filterwarnings("ignore:the field of view"), pytest.mark.usefixtures("tiny_demo")]


@pytest.fixture(scope="module")
def frames(sequences):
    return sequences / "clip0" / "rgb"


def test_demo(tmp_path, capsys, monkeypatch):
    truth = Truth(*(array[:4] for array in embedded.demo_clip()))
    monkeypatch.setattr(embedded, "demo_clip", lambda: truth)
    code, out, _ = run(capsys, "demo", "--out", tmp_path / "result")
    assert code == 0
    assert "errors against the truth" in out
    assert "peak memory" in out
    assert (tmp_path / "result" / "preview" / "truth.png").stat().st_size > 10_000
    page = tmp_path / "result" / "preview" / "viewer.html"
    assert str(page) in out
    assert page.stat().st_size > 100_000
    result = Reconstruction.load(tmp_path / "result")
    assert result.method == "4dvggt-m"
    is_matched = result.settings["masks"] in (SOURCE, "mined: matches between frames and Gram similarities")
    assert is_matched == (result.motion is not None)  # those of a tiny network need not come back
    assert "Masks by matches, second pass on this clip: " in out
    assert "such clips the second pass changes the mean errors" in out
    assert re.search(r"(?m)^consistent +(pixels|mined) ", out)
    assert "Depth and cameras fitted to the clip's pixels, compared with the first pass: rotation" in out
    assert result.settings["consistent_depth"] is True
    assert (tmp_path / "result" / "scene.glb").stat().st_size > 1000


def test_a_converted_model(tmp_path, capsys, golden):
    shapes = json.loads((golden / "shapes.json").read_text())
    tensors, model = seeded_state_dict(shapes, 7), tmp_path / "m.safetensors"
    save_file(tensors, tmp_path / "torch.safetensors")
    code, out, _ = run(capsys, "convert", tmp_path / "torch.safetensors", model, "--config", golden / "config.json")
    assert code == 0
    assert "wrote" in out
    code, out, _ = run(capsys, "info", model)
    assert code == 0
    assert "float32" in out
    token = load_model(model).params["backbone"]["class_token"]
    assert np.array_equal(np.ravel(token), np.ravel(tensors["aggregator.patch_embed.cls_token"]))
    model.write_bytes(b"another")
    again = ["convert", tmp_path / "torch.safetensors", model, "--config", golden / "config.json"]
    assert "exists and is not replaced" in refusal(capsys, *again)
    assert model.read_bytes() == b"another"
    assert run(capsys, *again, "--overwrite")[0] == 0
    assert load_model(model).config.depth == 24
    source = tmp_path / "torch.safetensors"
    linked, before = tmp_path / "link.safetensors", source.read_bytes()
    linked.hardlink_to(source)
    assert "is the source, which is never replaced" in refusal(capsys, "convert", source, linked, "--overwrite")
    assert source.read_bytes() == before


def test_a_shard_is_a_source_too(tmp_path, capsys, golden):
    shapes = json.loads((golden / "shapes.json").read_text())
    make_checkpoint(tmp_path / "shards", shapes, shards=2, seed=7)
    shard = tmp_path / "shards" / "model-00002-of-00002.safetensors"
    before = shard.read_bytes()
    config = ["--config", golden / "config.json", "--overwrite"]
    assert "is the source" in refusal(capsys, "convert", tmp_path / "shards", shard, *config)
    assert shard.read_bytes() == before


def test_a_source_or_a_strangers_file_in_the_output_folder_is_not_replaced(tmp_path, capsys, tiny_demo, sequences):
    result = tmp_path / "result"
    make_room(3).save(result)
    film = result / "preview" / "turntable.webp"
    shutil.copy(next((sequences / "clip0" / "rgb").iterdir()), film.with_suffix(".png"))
    before = sorted(result.rglob("*"))
    words = ("reconstruct", film.with_suffix(".png"), "--model", "demo", "--out", result)
    assert "is part of the result in" in refusal(capsys, *words)
    assert sorted(result.rglob("*")) == before
    run_folder = tmp_path / "run"
    run_folder.mkdir()
    model = run_folder / "model.safetensors"
    shutil.copy(tiny_demo, model)
    recipe = Path(__file__).parents[3] / "docs" / "recipes" / "smoke.json"
    (run_folder / "calibration.json").write_text(json.dumps({"format": FORMAT}))
    for arguments, words in (
        (("train", "--recipe", recipe, "--out", run_folder), "model.safetensors exists and is not part of an earlier"),
        (("train", "--recipe", recipe, "--out", run_folder, "--init", model), "is the source"),
        (("calibrate-cues", "--model", model, "--out", run_folder), "is the source"),
        (("calibrate-cues", "--model", run_folder, "--out", run_folder), "is the source"),
    ):
        assert words in refusal(capsys, *arguments)
        assert model.read_bytes() == tiny_demo.read_bytes()


def test_reconstruct_with_masks_and_tracks_of_ones_own(tmp_path, capsys, frames):
    masks = tmp_path / "masks"
    masks.mkdir()
    for i in range(4):
        box = np.pad(np.full((30, 40), 255, np.uint8), ((10, 56), (20, 36)))
        Image.fromarray(box).save(masks / f"{i:05d}.png")
    (tmp_path / "points.csv").write_text("x,y,frame\n60,45,0\n30,20,1\n", encoding="utf-8")
    code, out, err = run(
        capsys, "reconstruct", frames, "--model", "demo", "--out", tmp_path / "out", "--masks", masks, "--refine-mask",
        "--tracks", tmp_path / "points.csv", "--resolution", "original", "--format", "vggt4d",
    )  # fmt: skip
    assert code == 0, err
    assert "track head of this model is untrained" in out
    assert "The model demo is a small demonstration model" in out
    assert re.findall(r"(?m)^.*first pass", err) == ["first pass"]
    result = Reconstruction.load(tmp_path / "out")
    assert result.settings["model_note"].startswith("small demonstration model")
    assert (result.settings["masks"], result.settings["refine_mask"]) == ("given", True)
    assert result.settings["consistent_depth"] is True  # the command's default
    assert np.asarray(result.track_frames).tolist() == [0, 1]
    assert (tmp_path / "out/preview/tracks.png").stat().st_size > 1000
    with Image.open(tmp_path / "out/vggt4d/frame_0001.png") as shown, Image.open(frames / "00001.png") as picture:
        assert np.array_equal(np.asarray(shown), np.asarray(picture))

    arguments = ("import", tmp_path / "out/vggt4d", "--format", "vggt4d", "--out", tmp_path / "again")
    assert "does not say the order of its quaternions" in refusal(capsys, *arguments)
    code, _, err = run(capsys, *arguments, "--quaternion", "wxyz")
    assert code == 0, err
    again = Reconstruction.load(tmp_path / "again")
    assert np.allclose(again.camera_from_world, result.camera_from_world, atol=1e-5)

    arguments = ("--model", "demo", "--out", tmp_path / "still", "--no-masks", "--only", "cameras",
                 "--no-consistent-depth")  # fmt: skip
    code, _, err = run(capsys, "reconstruct", frames, *arguments)
    assert code == 0, err
    still = Reconstruction.load(tmp_path / "still")
    assert not still.dynamic_mask.any()
    assert still.settings["refine_mask"] is False
    assert still.settings["consistent_depth"] is False


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["reconstruct", "{frames}", "--out", "{tmp}/out", "--masks", "{tmp}/none"], "none"),
        (["reconstruct", "{tmp}/nothing", "--out", "{tmp}/out"], "does not exist"),
        (["reconstruct", "{frames}", "--out", "{tmp}/out"], "no model is named"),
        (["convert", "demo", "{tmp}/out.safetensors"], "demo is the embedded model, which needs no conversion"),
        (["convert", "{frames}/00000.png", "{tmp}/out.safetensors", "--heads", "camera,nose"], "heads has ['nose']"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_code_2(tmp_path, capsys, frames, arguments, sentence):
    places = {"tmp": tmp_path, "frames": frames}
    assert sentence in refusal(capsys, *(a.format(**places) for a in arguments))
    assert not (tmp_path / "out").exists() or not any((tmp_path / "out").iterdir())
    assert not (tmp_path / "out.safetensors").exists()


def test_a_reader_that_ends_early_is_no_error():
    command = [sys.executable, "-m", "vggtjax", "--version"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()  # type: ignore[union-attr]
        assert process.stderr.read() == b""  # type: ignore[union-attr]
    assert process.returncode == 1


def test_the_overview_names_every_command_once(capsys):
    code, out, err = run(capsys, "--help")
    assert (code, err) == (0, "")
    assert sorted(re.findall(r"(?m)^  (\S+)  ", out)) == sorted(cli.COMMANDS)
    groups = {command.group for command in cli.COMMANDS.values()}
    assert sum(line in groups for line in out.splitlines()) == len(groups)
    assert max(map(len, out.splitlines())) <= 90
    assert run(capsys) == (2, "", out)


def test_interruption_while_modules_are_imported(monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.delitem(sys.modules, "vggtjax.interface.commands.main")
    monkeypatch.setattr(sys, "meta_path", [type("Finder", (), {"find_spec": staticmethod(interrupted)})])
    assert __main__.answered() == 130
    assert capsys.readouterr().err == "vggtjax: interrupted\n"


def test_a_mistyped_command_or_flag_names_the_one_that_was_meant(capsys):
    said = refusal(capsys, "recontsruct", "clip.mp4")
    assert said == "vggtjax: there is no command 'recontsruct'; did you mean reconstruct? vggtjax --help lists all"
    assert "did you mean" not in run(capsys, "zzzz")[2]
    for gone in (("export-model", "demo", "--out", "x"), ("export_model",), ("view", "x", "--format=viser")):
        assert "is no longer there: " in refusal(capsys, *gone)
    with pytest.raises(SystemExit) as stop:
        run(capsys, "reconstruct", "clip.mp4", "--out", "x", "--max-frame", "8")
    assert stop.value.code == 2
    err = capsys.readouterr().err
    assert "--max-frames" in err
    assert "evaluate" not in err
    assert "vggtjax reconstruct --help" in err

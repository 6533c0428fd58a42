"""The command line: what it writes, what it says, and its exit codes."""

import dataclasses
import json
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from testing.seeded import seeded_images, seeded_state_dict
from vggtjax import Reconstruction, __main__
from vggtjax.clips.clip import load_clip
from vggtjax.clips.preprocessing import Framing
from vggtjax.clips.sampling import Sampling
from vggtjax.commands import main as cli
from vggtjax.commands.one_clip import _taken
from vggtjax.options import Options
from vggtjax.results.saving import Saving

pytestmark = [pytest.mark.filterwarnings("ignore:the field of view"), pytest.mark.usefixtures("tiny_demo")]


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    folder = tmp_path_factory.mktemp("frames")
    for i, image in enumerate(seeded_images(3, 90, 120, seed=1).transpose(0, 2, 3, 1)):
        Image.fromarray((255 * image).astype(np.uint8)).save(folder / f"frame_{i}.png")
    return folder


ORDER = ["input", "model", "method", "output"]


def run(capsys, *arguments) -> tuple[int, str, str]:
    code = cli.main([str(a) for a in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_demo(tmp_path, capsys):
    code, out, _ = run(capsys, "demo", "--out", tmp_path / "result")
    assert code == 0
    assert "errors against the truth" in out
    assert "peak memory" in out
    assert (tmp_path / "result" / "preview" / "truth.png").stat().st_size > 10_000
    page = tmp_path / "result" / "preview" / "viewer.html"
    assert str(page) in out
    assert page.stat().st_size > 100_000
    result = Reconstruction.load(tmp_path / "result")
    assert result.method == "4dvggt-d"
    assert (tmp_path / "result" / "scene.glb").stat().st_size > 1000


def test_reconstruct_with_a_converted_model(tmp_path, capsys, frames, golden, monkeypatch):
    from safetensors.numpy import save_file

    monkeypatch.setenv("VGGTJAX_CACHE", str(tmp_path / "cache"))
    shapes = json.loads((golden / "shapes.json").read_text())
    save_file(seeded_state_dict(shapes, 7), tmp_path / "torch.safetensors")
    config = golden / "config.json"
    code, out, _ = run(
        capsys, "convert", tmp_path / "torch.safetensors", tmp_path / "m.safetensors", "--config", config
    )
    assert code == 0
    assert "wrote" in out
    code, out, _ = run(capsys, "info", tmp_path / "m.safetensors")
    assert code == 0
    assert "float32" in out
    code, out, err = run(
        capsys, "reconstruct", frames, "--model", tmp_path / "m.safetensors", "--out", tmp_path / "out", "--max-frames",
        2, "--method", "pose-decoupling",
    )  # fmt: skip
    assert code == 0, err
    result = Reconstruction.load(tmp_path / "out")
    assert result.depth.shape == (2, 112, 140)
    assert result.frame_names == ("frame_0", "frame_1")
    assert result.method == "pose-decoupling"


def test_reconstruct_with_masks_and_tracks_of_ones_own(tmp_path, capsys, frames):
    masks = tmp_path / "masks"
    masks.mkdir()
    for i in range(3):
        Image.fromarray(np.pad(np.full((30, 40), 255, np.uint8), ((10, 50), (20, 60)))).save(masks / f"frame_{i}.png")
    (tmp_path / "points.csv").write_text("x,y,frame\n60,45,0\n30,20,1\n", encoding="utf-8")
    code, out, err = run(
        capsys, "reconstruct", frames, "--model", "demo", "--out", tmp_path / "out", "--masks", masks, "--refine-mask",
        "--tracks", tmp_path / "points.csv", "--method", "vggt4d", "--resolution", "original", "--format", "vggt4d",
    )  # fmt: skip
    assert code == 0, err
    assert "track head of this model is untrained" in out
    assert "The model demo is a small demonstration model" in out
    assert re.findall(r"(?m)^.*first pass", err) == ["first pass"]
    result = Reconstruction.load(tmp_path / "out")
    assert result.settings["model_note"].startswith("small demonstration model")
    assert (result.settings["masks"], result.settings["refine_mask"]) == ("given", True)
    assert np.asarray(result.track_frames).tolist() == [0, 1]
    assert (tmp_path / "out/preview/tracks.png").stat().st_size > 1000
    with Image.open(tmp_path / "out/mask/000001.png") as mask, Image.open(frames / "frame_1.png") as picture:
        assert mask.size == picture.size
        with Image.open(tmp_path / "out/vggt4d/frame_0001.png") as shown:
            assert np.array_equal(np.asarray(shown), np.asarray(picture.convert("RGB")))

    arguments = ("import", tmp_path / "out/vggt4d", "--format", "vggt4d", "--out", tmp_path / "again")
    code, _, err = run(capsys, *arguments)
    assert code == 2
    assert "does not say the order of its quaternions" in err
    code, _, err = run(capsys, *arguments, "--quaternion", "wxyz")
    assert code == 0, err
    again = Reconstruction.load(tmp_path / "again")
    assert again.depth.shape == (3, *picture.size[::-1])
    assert np.allclose(again.camera_from_world, result.camera_from_world, atol=1e-5)

    arguments = ("--model", "demo", "--out", tmp_path / "still", "--no-masks", "--tracks", "grid:2")
    code, _, err = run(capsys, "reconstruct", frames, *arguments)
    assert code == 0, err
    still = Reconstruction.load(tmp_path / "still")
    assert not still.dynamic_mask.any()
    assert still.settings["refine_mask"] is False
    assert np.asarray(still.track_positions).shape == (3, 4, 2)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["reconstruct", "{frames}", "--out", "{tmp}/out", "--masks", "{tmp}/none"], "none"),
        (["reconstruct", "{frames}", "--out", "{tmp}/out", "--refine-mask", "--no-refine-mask"], "opposites"),
        (["reconstruct", "{tmp}/nothing", "--out", "{tmp}/out"], "does not exist"),
        (["reconstruct", "{frames}", "--out", "{tmp}/out"], "no model is named"),
        (["reconstruct", "{tmp}", "--out", "{tmp}/out"], "no images"),
        (["reconstruct", "{tmp}/a.mp4", "--out", "{tmp}/out"], "cannot read video"),
        (["train", "--recipe", "{tmp}/a.mp4", "--out", "{tmp}/out"], "vggtjax: recipe "),
        (["convert", "demo", "{tmp}/out.safetensors"], "demo is the embedded model, which needs no conversion"),
        (["reconstruct", "{frames}", "--model", "demo", "--out", "{tmp}/out", "--start", "7"], "start is 7"),
        (["reconstruct", "{frames}", "--out", "{tmp}/out", "--smooth-frames", "2"], "an odd number of frames"),
        (["import", "{frames}", "--format", "da3", "--out", "{tmp}/out"], "it has no results.npz"),
        (["convert", "{frames}/frame_0.png", "{tmp}/out.safetensors", "--heads", "camera,nose"], "heads has ['nose']"),
        (["info", "{frames}/frame_0.png"], "frame_0.png"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_code_2(tmp_path, capsys, frames, arguments, sentence):
    places = {"tmp": tmp_path, "frames": frames}
    (tmp_path / "a.mp4").write_text("no video")
    code, _, err = run(capsys, *(a.format(**places) for a in arguments))
    assert code == 2
    last = err.strip().splitlines()[-1]
    assert last.startswith("vggtjax: ")
    assert sentence in last
    assert err.count("vggtjax: ") == 1
    assert not (tmp_path / "out").exists() or not any((tmp_path / "out").iterdir())
    assert not (tmp_path / "out.safetensors").exists()


def test_a_reader_that_ends_early_is_no_error():
    command = [sys.executable, "-m", "vggtjax", "--version"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 1


def test_an_odd_name_of_a_clip_is_printed_on_one_line(capsys, tmp_path, frames):
    (tmp_path / "c\nd").mkdir()
    shutil.copy(frames / "frame_0.png", tmp_path / "c\nd")
    code, out, err = run(capsys, "batch", tmp_path / "c\nd", "--out", tmp_path / "out", "--model", "demo")
    assert code == 2
    assert "c d failed: a clip is named 'c\\nd'" in out
    assert "1/1 c d: failed" in err


@pytest.mark.parametrize("command", ["reconstruct", "batch", "evaluate"])
def test_commands_that_reconstruct_have_all_options_in_the_order_of_use(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    with pytest.raises(SystemExit, match="0"):
        cli.main([command, "--help"])
    page = capsys.readouterr().out
    flags = set(re.findall(r"--[a-z-]+", page))
    order = [name for name in re.findall(r"(?m)^\W*(\w+)[\w ]* options\b", page) if name in ORDER]
    assert order == ORDER
    assert not [word for word in ("default: None", "default: False", "Union") if word in page]
    groups = [Options, Sampling, Framing, *([] if command == "evaluate" else [Saving])]
    names = {field.name for group in groups for field in dataclasses.fields(group)} - {"compute_dtype", "mode"} | {
        "dtype",
        "preprocess",
    }
    names = names | {"model", "config", "fusion"}
    # evaluate has --methods, takes pictures without times, and measures methods as they are.
    absent = {"--method", "--fps", "--refine-cameras"} if command == "evaluate" else set()
    assert {f"--{name.replace('_', '-')}" for name in names} - flags == absent


def test_the_overview_names_every_command_once(capsys):
    code, out, err = run(capsys, "--help")
    assert (code, err) == (0, "")
    assert sorted(re.findall(r"(?m)^  (\S+)  ", out)) == sorted(cli.COMMANDS)
    assert max(map(len, out.splitlines())) <= 90
    assert run(capsys) == (2, "", out)


def test_interruption_while_modules_are_imported(monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.delitem(sys.modules, "vggtjax.commands.main")
    monkeypatch.setattr(sys, "meta_path", [type("Finder", (), {"find_spec": staticmethod(interrupted)})])
    assert __main__.run() == 130
    assert capsys.readouterr().err == "vggtjax: interrupted\n"


def test_a_mistyped_command_or_flag_names_the_one_that_was_meant(capsys):
    code, _, err = run(capsys, "recontsruct", "clip.mp4")
    assert code == 2
    assert err == ("vggtjax: there is no command 'recontsruct'; did you mean reconstruct? vggtjax --help lists all\n")
    assert "did you mean" not in run(capsys, "zzzz")[2]
    with pytest.raises(SystemExit) as stop:
        run(capsys, "reconstruct", "clip.mp4", "--out", "x", "--max-frame", "8")
    assert stop.value.code == 2
    err = capsys.readouterr().err
    assert "--max-frames" in err
    assert "evaluate" not in err
    assert "vggtjax reconstruct --help" in err


@pytest.mark.parametrize(
    ("count", "available", "stride", "ending"),
    [
        (4, 49, None, "; --stride 13 spreads them over the whole source"),
        (4, 49, 13, ""),
        (4, 4, None, ""),
        (4, None, None, ""),
    ],
)
def test_the_frames_that_were_taken_are_named(count, available, stride, ending):
    clip = load_clip(np.zeros((count, 20, 40, 3), np.uint8), size=56)
    clip = dataclasses.replace(clip, sampling=Sampling(stride=stride, max_frames=count))
    frames = f"{count} of {available}" if available and available > count else f"{count}"
    assert _taken(clip, available) == f"{frames} frames of 40 x 20 pixels, fitted to 56 x 28{ending}"

"""One job without a browser: files are checked first, everything is there to download, errors are sentences."""

import zipfile
from contextlib import nullcontext
from pathlib import Path

import pytest
from PIL import Image

from tests.shared.room import make_room
from vggtjax.errors import CheckpointError, ClipError, InputError, ResultError
from vggtjax.interface.app import outputs
from vggtjax.interface.app.limits import Limits
from vggtjax.interface.app.run import Runner, sentence


@pytest.fixture
def reconstructed(monkeypatch):
    """Let a generated room be every result; return what was asked for: the network has tests of its own."""
    asked = []

    def reconstruct(model, clip, **options):
        asked.append((clip.images.shape, options["method"], options["consistent_depth"]))
        return make_room(len(clip.images))

    monkeypatch.setattr("vggtjax.pipeline.run.reconstruct", reconstruct)
    monkeypatch.setattr(outputs, "_FILM_SECONDS", 0.2)
    monkeypatch.setattr(outputs, "_FILM_SIZE", (64, 36))
    return asked


@pytest.mark.usefixtures("tiny_demo")
def test_the_demo_clip_leaves_everything_to_download_and_nothing_else(tmp_path, reconstructed):
    stages = []

    def on_stage(name):
        stages.append(name)
        return nullcontext()

    runner = Runner((), Limits())
    facts, shown, offered = runner.run([], "demo", "vggt", 4, 0, tmp_path, on_stage)
    assert reconstructed == [((4, 96, 96, 3), "vggt", True)]
    assert "4 frames of 42 x 28 pixels" in facts
    assert stages[:3] == ["check the clip", "load model", "load clip"]
    with zipfile.ZipFile(offered[0]) as archive:
        names = {Path(name).name for name in archive.namelist()}
    assert names >= {"reconstruction.npz", "report.html", "scene.glb", "film.mp4", "layers.mp4", "sheet.png"}
    assert [path.name for path in shown] == ["viewer.html", "film.mp4", "layers.mp4", "sheet.png"]
    assert {path for path in tmp_path.rglob("*") if path.is_file()} == {*shown, *offered}


@pytest.mark.usefixtures("tiny_demo", "reconstructed")
def test_a_cancelled_job_leaves_no_file(tmp_path):
    def on_stage(name):
        if name == "zip":
            raise KeyError(name)
        return nullcontext()

    with pytest.raises(KeyError):
        Runner((), Limits()).run([], "demo", "vggt", 2, 0, tmp_path, on_stage)
    assert not any(tmp_path.iterdir())


@pytest.mark.usefixtures("tiny_demo")
def test_a_job_of_no_frames_has_one(tmp_path, reconstructed):
    def on_stage(name):
        if name == "write files":
            raise KeyError(name)
        return nullcontext()

    with pytest.raises(KeyError):
        Runner((), Limits()).run([], "demo", "vggt", 0, 0, tmp_path, on_stage)
    assert reconstructed[0][0][0] == 1


@pytest.mark.usefixtures("tiny_demo", "reconstructed")
@pytest.mark.parametrize(("name", "stem"), [("..<b> c.png", "b-c"), ("....png", "clip"), ("é" * 90 + ".png", "clip")])
def test_results_have_safe_names(tmp_path, name, stem):
    Image.new("RGB", (28, 28), "teal").save(tmp_path / name, "PNG")
    offered = Runner((), Limits()).run([tmp_path / name] * 2, "demo", "vggt", 2, 0, tmp_path, lambda _: nullcontext())[
        2
    ]
    assert offered[0].name == f"{stem}-vggt.zip"


def test_files_are_checked_before_the_model_is_loaded(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "vggtjax.pipeline.pretrained.load.load_model", lambda *_, **__: pytest.fail("a model was loaded")
    )
    (tmp_path / "holiday.mp4").write_bytes(b"words")
    with pytest.raises(ClipError) as raised:
        Runner((), Limits()).run([tmp_path / "holiday.mp4"], "demo", "vggt", 2, 0, tmp_path, lambda _: nullcontext())
    said = sentence(raised.value, [tmp_path])
    assert said.startswith("cannot read video holiday.mp4")
    assert str(tmp_path) not in said


def test_models_have_names_without_folders_and_one_name_each(tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "large.safetensors").write_bytes(b"")
    first, second = (str(tmp_path / folder / "large.safetensors") for folder in "ab")
    assert list(Runner((first, "facebook/VGGT-1B", first), Limits()).names) == [
        "large.safetensors",
        "facebook/VGGT-1B",
        "demo",
    ]
    assert tmp_path / "a" in Runner((first,), Limits()).folders
    with pytest.raises(InputError, match=r"two models are named large\.safetensors"):
        Runner((first, second), Limits())
    with pytest.raises(InputError, match="model is 'other'"):
        Runner((), Limits()).model("other")


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ResultError("frame 3 is broken; send it again"), "frame 3 is broken; send it again"),
        (
            ClipError("/tmp/a b/app/" + "0" * 64 + "/x.mp4: broken; see https://a.org/b/c"),
            "x.mp4: broken; see https://a.org/b/c",
        ),
        (ClipError("cannot read (/home/me/models/x.npz)"), "cannot read (x.npz)"),
        (CheckpointError("/srv/my models/large/x.safetensors is cut off"), "x.safetensors is cut off"),
        (MemoryError(), "this machine has too little memory for the job; choose fewer frames"),
        (
            RuntimeError("RESOURCE_EXHAUSTED: secret"),
            "this machine has too little memory for the job; choose fewer frames",
        ),
        (OSError(28, "secret"), "the program failed; the person who runs this app finds the reason in its log"),
        (ZeroDivisionError("secret"), "the program failed; the person who runs this app finds the reason in its log"),
    ],
)
def test_an_error_is_a_sentence_without_paths(error, said):
    assert sentence(error, [Path("/tmp/a b/app"), Path("/srv"), Path("/srv/my models")]) == said

"""Commands of benchmarks: what one measures of another program, the files that one makes, and bad input."""

import json

import numpy as np
import pytest

from benchmarks import __main__ as benchmarks
from benchmarks import (
    command_worker,
    embed,
)
from tests.benchmarks.scenes import SIDE, drawn_scenes, tiny_file
from vggtjax.checkpoint import read_model
from vggtjax.errors import InputError
from vggtjax.pretrained.embedded import demo_clip

pytestmark = pytest.mark.filterwarnings("ignore:the field of view")


def test_what_a_command_takes(capfd, tmp_path):
    command_worker.main(["--version"])
    answer = json.loads(capfd.readouterr().out.splitlines()[-1])
    assert answer["code"] == 0
    assert answer["seconds"] > 0
    words = ["reconstruct", "none", "--model", "demo", "--out", str(tmp_path / "out")]
    with pytest.raises(InputError, match=r"reconstruct none --model demo .* ended with code 2: .*none"):
        command_worker.run_command(words, tmp_path)


@pytest.mark.proof
def test_embed(tmp_path, monkeypatch, capsys):
    for name in ("MODEL", "CLIP"):
        monkeypatch.setattr(embed, name, tmp_path / name)
    monkeypatch.setattr(embed, "held_out_scenes", drawn_scenes)
    monkeypatch.setattr(embed, "demo_model", lambda: read_model(tmp_path / "MODEL"))
    tiny, small = str(tiny_file(tmp_path)), f"--scenes 3 --frames 3 --image-size {2 * SIDE}"
    assert benchmarks.main(["embed", tiny, *small.split()]) == 0
    model = read_model(tmp_path / "MODEL")
    assert (model.name, model.config.image_size) == ("demo", 2 * SIDE)
    assert f"{(tmp_path / 'CLIP').stat().st_size} bytes" in capsys.readouterr().out
    assert demo_clip(tmp_path / "CLIP").images.shape == (3, 2 * SIDE, 2 * SIDE, 3)
    assert embed._by_ranks(np.array([[3, 3], [1, 2], [2, 1.5]])).tolist() == [1, 2, 0]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ("demo-model --frames 2", "frames is 2; expected at least 3"),
        ("gpu-day --out {tmp} --parts nothing", "parts is 'nothing'; expected one of parity"),
        ("gpu-day --out {tmp}", "is not empty; choose a new folder"),
        ("long-clips --out {tmp}/out --frames 16", "expected at least 0 walks, longer than a window"),
        ("second-pass --pairs 99", "expected numbers from 1 to 12"),
        ("speed --weights {tmp}/a --converted {tmp}/b --peer {tmp}", "a does not exist"),
        ("suite --against {tmp}/file", "is not a run that --out wrote"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_code_2(tmp_path, capsys, arguments, sentence):
    (tmp_path / "file").touch()
    assert benchmarks.main(arguments.format(tmp=tmp_path).split()) == 2
    error = capsys.readouterr().err
    assert error.startswith("benchmarks: ")
    assert sentence in error
    assert len(error.strip().splitlines()) == 1

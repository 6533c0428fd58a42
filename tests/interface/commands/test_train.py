import functools
import json
from pathlib import Path

import numpy as np
import pytest

from tests.shared.training_runs import PROBES, TASK
from vggtjax.errors import CheckpointError, InputError, MissingExtraError
from vggtjax.interface.commands import train as command
from vggtjax.network.checkpoint import read_model, save_model
from vggtjax.network.model import init_params
from vggtjax.training import loop
from vggtjax.training.metrics import read_metrics
from vggtjax.training.options import RunOptions

SMOKE = Path(__file__).parents[3] / "docs" / "recipes" / "smoke.json"


@pytest.fixture
def recipe(tmp_path, monkeypatch):
    """A file with a recipe; the loop that the command calls runs on the tests' small parts."""
    monkeypatch.setattr(loop, "train", functools.partial(loop.train, task=TASK))
    path = tmp_path / "recipe.json"
    path.write_text(PROBES.to_json())
    return path


def test_the_smoke_recipe_runs_in_seconds(tmp_path, capsys):
    command.train(SMOKE, tmp_path, options=RunOptions(log_every=5))
    captured = capsys.readouterr()
    assert "10 of 10" in captured.out
    assert "the first step with each phase" in captured.err
    rows = read_metrics(tmp_path / "metrics.csv")
    assert len(rows) == 2
    assert np.isfinite([row["loss"] for row in rows]).all()
    model = read_model(tmp_path / "model.safetensors")
    assert (model.config.heads, model.config.image_size) == (("camera",), 16)


def test_fewer_steps_from_a_model_and_a_run_that_goes_on(recipe, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(command, "_LINE_SECONDS", 0.0)
    params = init_params(4, PROBES.model)
    labels = {"note": "first attempt", "untrained_heads": ["camera", "points"]}
    start = save_model(tmp_path / "start.safetensors", params, PROBES.model, **labels)
    out = tmp_path / "out"
    command.train(recipe, out, init=str(start), steps=3, options=RunOptions(seconds=1e-9, dtype="bfloat16"))
    assert "1 of 3; the same command resumes the run" in capsys.readouterr().out
    model = read_model(out / "model.safetensors")
    assert model.dtype == "bfloat16"
    assert (model.note, model.untrained_heads) == ("first attempt", ("camera", "points"))
    token, own = (np.asarray(tree["backbone"]["class_token"], np.float32) for tree in (model.params, params))
    np.testing.assert_allclose(token, own, rtol=0.01)
    assert json.loads((out / "recipe.json").read_text())["stages"][0]["steps"] == 2
    command.train(recipe, out, steps=3, options=RunOptions(log_every=2, dtype="bfloat16"))  # without --init: resumed
    said = capsys.readouterr().out
    assert "step 2 of 3, phase 1, loss " in said
    assert "3 of 3" in said
    assert str(out / "model.safetensors") in said
    assert read_model(out / "model.safetensors").note == "first attempt"
    assert [row["step"] for row in read_metrics(out / "metrics.csv")][-1] == 3


def test_bad_input(recipe, tmp_path, monkeypatch):
    for values, says in (
        ({"seconds": 0.0}, "seconds is 0.0"),
        ({"log_every": 0}, "log_every is 0"),
        ({"dtype": "float16"}, "dtype is 'float16'"),
    ):
        with pytest.raises(InputError, match=says):
            RunOptions(**values)  # type: ignore[arg-type]
    with pytest.raises(CheckpointError):
        command.train(recipe, tmp_path / "out", init="demo")  # another configuration
    assert not (tmp_path / "out").exists()
    monkeypatch.setattr("vggtjax.errors.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"\.\[train\]"):
        command.train(recipe, tmp_path / "out")

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest

from tests.shared.tiny import tiny_model
from vggtjax.errors import InputError
from vggtjax.method.assembly import check_fuses
from vggtjax.method.fusion.family import paper_rule
from vggtjax.network.checkpoint import read_model, save_model
from vggtjax.progress import no_stage
from vggtjax.research.evaluation.datasets.sequence import LabelledSequence
from vggtjax.research.evaluation.sources import FolderSource, ModelSource


@pytest.fixture(scope="module")
def model():
    return tiny_model()


def retrained(model):
    params = jax.tree.map(lambda leaf: np.asarray(leaf) * np.float32(1.001), model.params)
    return dataclasses.replace(model, params=params)


def test_retrained_weights_are_another_model(tmp_path, model):
    read = read_model(save_model(tmp_path / "m.safetensors", model.params, model.config))
    read_again = read_model(save_model(tmp_path / "m.safetensors", retrained(model).params, model.config))
    for one, other in ((model, retrained(model)), (read, read_again), (read, retrained(read))):
        before, again = ModelSource(one, ["vggt"]).settings, ModelSource(one, ["vggt"]).settings
        assert before == again
        assert ModelSource(other, ["vggt"]).settings["model"]["sha256"] != before["model"]["sha256"]


def test_methods_that_do_not_fuse_run_beside_those_that_do(monkeypatch, model):
    fusion, calls = paper_rule(), []

    def methods(model, clip, names, *, fusion, **_):
        check_fuses(fusion, *names)  # as reconstruct_methods does
        calls.append((names, fusion))

    monkeypatch.setattr("vggtjax.pipeline.several.reconstruct_methods", methods)
    monkeypatch.setattr("vggtjax.clips.clip.read_clip", lambda *_: None)
    monkeypatch.setattr("vggtjax.clips.sources.open_source", lambda *_: None)
    source = ModelSource(model, ["vggt4d", "4dvggt-d"], fusion=fusion)
    sequence = LabelledSequence("s", (Path("0.png"),))
    for group in source.groups:
        source.results(group, sequence, no_stage)
    assert calls == [(["vggt4d"], None), (["4dvggt-d"], fusion)]
    with pytest.raises(InputError, match="'vggt4d' does not fuse"):
        ModelSource(model, ["vggt4d"], fusion=fusion)


@pytest.mark.parametrize("name", ["caf\udce9", "n" * 300, ""])
def test_names_of_results_are_short_and_printable(tmp_path, name):
    with pytest.raises(InputError, match="expected a short printable name") as error:
        FolderSource({name: tmp_path})
    assert str(error.value).isprintable()

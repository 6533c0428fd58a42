"""Arguments of another class than their own."""

import numpy as np
import pytest

from tests.shared.tiny import tiny_model
from vggtjax import Options, reconstruct
from vggtjax.errors import InputError
from vggtjax.pipeline.run import compile_ahead
from vggtjax.pipeline.several import reconstruct_methods

CLIP = np.zeros((2, 56, 56, 3), np.uint8)


def test_arguments_in_the_wrong_place_are_named():
    model = tiny_model()
    for run, message in (
        (lambda: reconstruct(CLIP, model), r"model is ndarray .*; expected what load_model returned: reconstruct\(mod"),  # type: ignore
        (lambda: reconstruct("demo", CLIP), "model is str 'demo'; expected what load_model returned"),  # type: ignore
        (lambda: reconstruct(model.params, CLIP), "model is dict"),  # type: ignore
        (lambda: reconstruct(model, CLIP, options="vggt"), "options is str 'vggt'; .* its fields by name"),  # type: ignore
        (lambda: reconstruct(model, CLIP, options=Options), "options is Options; expected Options"),  # type: ignore
        (lambda: reconstruct(model, CLIP, running={"devices": 1}), "running is dict"),  # type: ignore
        (lambda: reconstruct(model, CLIP, known={"baseline": 1}), "known is dict .*; expected KnownGeometry"),  # type: ignore
        (lambda: reconstruct(model, CLIP, tracks=[[1, 2]]), "tracks is list"),  # type: ignore
        (lambda: compile_ahead("demo", 2, 56, 56), "model is str 'demo'"),  # type: ignore
        (lambda: reconstruct_methods(CLIP, model, ["vggt"]), "model is ndarray"),  # type: ignore
    ):
        with pytest.raises(InputError, match=message):
            run()

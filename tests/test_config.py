"""The configuration: hashable, checked, and readable from a stranger's JSON."""

import json
import re
import subprocess
import sys

import pytest

from vggtjax import VGGTConfig
from vggtjax.config import MotionConfig
from vggtjax.errors import InputError


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"taps": (4, 11, 17, 24)}, "below depth 24"),
        ({"depth": 0}, "depth is 0; expected a whole number of at least 1"),
        ({"heads": ("depth", "camera")}, "in this order"),
        ({"heads": ("depth", "nose")}, r"heads has \['nose'\]; expected some of \('camera', 'depth'"),
        ({"embed_dim": 1000}, "embed_dim 1000 is not a multiple"),
        ({"dpt_channels": (4, 4, 4, 6)}, "of 4"),
        ({"motion": {"offsets": (0,)}}, "offsets other than 0"),
    ],
)
def test_bad_values_are_named(change, sentence):
    with pytest.raises(InputError, match=sentence):
        VGGTConfig(**change)


def test_bad_cues_are_named():
    cue = json.loads(VGGTConfig().to_json())["motion"]["cues"][0]
    for change, sentence in (
        ({"layers": [24]}, "cue 'shallow_kk_mean' has layers (24,)"),
        ({"layers": []}, "motion.cues[0].layers is []"),
        ({"rows": "v"}, "motion.cues[0].rows is 'v'; expected one of"),
        ({"row": "k"}, "motion.cues[0] has unknown fields ['row']"),
    ):
        with pytest.raises(InputError, match=re.escape(sentence)):
            MotionConfig(cues=(cue | change,))  # pyright: ignore[reportArgumentType]: mappings become cues


@pytest.mark.parametrize(
    ("modules", "late"),
    [
        ("vggtjax.interface.commands.main, vggtjax.config, vggtjax.clips.clip", ["jax", "gradio"]),
        (
            "vggtjax.interface.commands.reconstruct, vggtjax.pipeline.run",
            ["scipy.spatial", "scipy.ndimage", "scipy.linalg", "skimage.segmentation", "skimage.morphology"],
        ),
    ],
)
def test_what_takes_long_to_import_is_imported_where_it_is_used(modules, late):
    code = f"import sys, {modules}; print([name for name in {late} if name in sys.modules])"
    ran = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert ran.stdout == "[]\n"

"""The configuration: hashable, checked, and readable from a stranger's JSON."""

import json
import re
import subprocess
import sys

import pytest

from vggtjax import MotionConfig, VGGTConfig, vggt_1b
from vggtjax.errors import InputError


def test_defaults_are_vggt_1b(golden):
    assert VGGTConfig() == vggt_1b()
    assert hash(VGGTConfig()) == hash(vggt_1b())
    assert VGGTConfig().tap_dim == 2048
    assert VGGTConfig().grid_size == 37


def test_lists_become_tuples(config):
    assert config.taps == (4, 11, 17, 23)
    assert isinstance(hash(config), int)


def test_json_round_trip(config):
    assert VGGTConfig.from_json(config.to_json()) == config


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"taps": (4, 11, 17, 24)}, "below depth 24"),
        ({"taps": (4, 11, 17)}, "list of 4 values"),
        ({"depth": 0}, "depth is 0; expected a whole number of at least 1"),
        ({"depth": "24"}, "depth is '24'; expected a whole number"),
        ({"depth": True}, "depth is True"),
        ({"heads": ("depth", "camera")}, "in this order"),
        ({"embed_dim": 1000}, "embed_dim 1000 is not a multiple"),
        ({"image_size": 500}, "multiple of patch_size"),
        ({"dpt_features": 20}, "dpt_features 20"),
        ({"dpt_channels": (4, 4, 4, 6)}, "of 4"),
        ({"embed_dim": 10**12}, "at most 1000000"),
        ({"motion": {"offsets": (0,)}}, "offsets other than 0"),
        ({"motion": {"cues": []}}, "cues is .*at least 1 values"),
        ({"motion": {"mask_pairs": 10**12}}, "mask_pairs is 1000000000000; expected a whole number .* at most 1000000"),
        ({"motion": {"floor": 1.5}}, "floor is 1.5; expected a number of at least 0 and at most 1"),
    ],
)
def test_bad_values_are_named(change, sentence):
    with pytest.raises(InputError, match=sentence):
        VGGTConfig(**change)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{",
        '{"depht": 3}',
        '{"motion": 3}',
        '{"motion": {"cues": [3]}}',
        '{"taps": 3}',
        "[" * 100_000,
        '{"motion": {"offsets": ["a"]}}',
        '{"motion": {"offsets": [{}]}}',
        '{"motion": {"offsets": 2}}',
        '{"motion": {"reference_depth": "x"}}',
        '{"track_position_embedding": "x"}',
    ],
)
def test_bad_json_is_one_sentence(text):
    with pytest.raises(InputError):
        VGGTConfig.from_json(text)


def test_bad_cues_are_named():
    cue = json.loads(VGGTConfig().to_json())["motion"]["cues"][0]
    for change, sentence in (
        ({"layers": [24]}, "cue 'shallow_kk_mean' has layers (24,)"),
        ({"layers": []}, "motion.cues[0].layers is []"),
        ({"layers": [[]]}, "motion.cues[0].layers[0] is []"),
        ({"rows": "v"}, "motion.cues[0].rows is 'v'; expected one of"),
        ({"rows": []}, "motion.cues[0].rows is []"),
        ({"statistic": "median"}, "motion.cues[0].statistic is 'median'"),
        ({"name": 3}, "motion.cues[0].name is 3; expected text"),
        ({"row": "k"}, "motion.cues[0] has unknown fields ['row']"),
    ):
        with pytest.raises(InputError, match=re.escape(sentence)):
            MotionConfig(cues=(cue | change,))  # pyright: ignore[reportArgumentType]: mappings become cues


def test_the_command_line_starts_without_jax():
    code = "import sys, vggtjax.commands.main, vggtjax.config, vggtjax.clips.clip; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_reconstruction_starts_without_the_parts_of_scipy_and_scikit_image():
    late = ("scipy.spatial", "scipy.ndimage", "scipy.linalg", "skimage.segmentation", "skimage.morphology")
    code = "import sys, vggtjax.commands.reconstruct, vggtjax.pipeline.run; "
    code += f"print([name for name in {late} if name in sys.modules])"
    ran = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert ran.stdout == "[]\n"

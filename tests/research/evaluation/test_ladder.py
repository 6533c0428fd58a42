import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.shared.da3 import TINY
from tests.shared.seeded import seeded_images
from tests.shared.tiny import tiny_config
from vggtjax import Reconstruction, assemble, forward, infer, init_params, load_clip
from vggtjax.cameras import checked_centres, umeyama_sim3
from vggtjax.clips.truth import Truth
from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError
from vggtjax.method.mask import upsample
from vggtjax.method.passes import Passes
from vggtjax.network.checkpoint import Model
from vggtjax.network.heads.pose import encode_pose
from vggtjax.options import ABLATION
from vggtjax.pipeline.fields import clip_fields
from vggtjax.research.evaluation.ladder import LadderRow, ladder, score_result
from vggtjax.research.evaluation.ladder_words import (
    Change,
    SecondPass,
    error_table,
    many_in_words,
    read_second_pass,
    second_pass_in_words,
    write_second_pass,
)
from vggtjax.research.evaluation.metrics.depth import depth_errors, median_scale
from vggtjax.research.evaluation.metrics.masks import auc, jaccard
from vggtjax.research.evaluation.metrics.trajectory import centre_error, rotation_error

CLIPS, FRAMES, SIZE = 3, 4, (28, 42)
SETTING = ("method", "mask_source", "mask_pairs", "suppress")


def tiny_model(config: VGGTConfig) -> Model:
    def louder(path, leaf):  # let what attention sees matter
        return leaf + 0.3 if path[-1].key in ("scale1", "scale2") else leaf

    params = init_params(3, config)
    for blocks in ("frame_blocks", "global_blocks"):
        params["aggregator"][blocks] = jax.tree_util.tree_map_with_path(louder, params["aggregator"][blocks])
    return Model(config, params, "tiny")


@pytest.fixture(scope="module")
def model() -> Model:
    return tiny_model(tiny_config())


@pytest.fixture(scope="module")
def truth() -> Truth:
    generator = np.random.default_rng(0)
    H, W = SIZE
    images = np.stack([seeded_images(FRAMES, H, W, seed=clip).transpose(0, 2, 3, 1) for clip in range(CLIPS)])
    depth = np.exp(0.3 * generator.normal(size=(CLIPS, FRAMES, H, W))).astype(np.float32)
    depth[:, :, :3] = 0  # not measured
    mask = np.zeros((CLIPS, FRAMES, H, W), bool)
    mask[:, :, 8:20, 14:30] = True
    rotation = Rotation.from_rotvec(0.1 * generator.normal(size=(CLIPS * FRAMES, 3))).as_matrix()
    poses = np.concatenate([rotation, generator.normal(size=(CLIPS * FRAMES, 3, 1))], axis=2)
    intrinsics = np.tile(np.array([[50, 0, W / 2], [0, 50, H / 2], [0, 0, 1]]), (CLIPS, FRAMES, 1, 1))
    return Truth(images, depth, mask, poses.reshape(CLIPS, FRAMES, 3, 4), intrinsics)


@pytest.fixture(scope="module")
def passes(model, truth) -> Passes:
    """Both passes of the first two clips, by the library's own single jit."""
    return infer(model.params, truth.images[:2], model.config, mask_pairs=2)[1]


@pytest.fixture(scope="module")
def rows(model, truth) -> list[LadderRow]:
    seen = []
    found = ladder(model, truth, mask_pairs=(0, 2), batch_size=2, progress=lambda *counts: seen.append(counts))
    assert seen == [(done, 2 * (1 + 4)) for done in range(1, 11)]
    return found


def close(a: LadderRow, b: LadderRow) -> bool:
    names = [name for name, value in vars(a).items() if isinstance(value, float)]
    return [getattr(a, name) for name in names] == pytest.approx([getattr(b, name) for name in names], rel=1e-3)


def only(rows, **wanted) -> LadderRow:
    (row,) = (row for row in rows if all(getattr(row, name) == value for name, value in wanted.items()))
    return row


def test_every_setting_has_a_row(rows):
    sources, pairs = ("mined", "true"), (0, 2)
    masked = [(name, source, number, "zero") for source in sources for number in pairs for name in ABLATION[1:]]
    settings = [("vggt", None, None, None), *masked]
    found = [(row.clip, *(getattr(row, name) for name in SETTING)) for row in rows]
    assert found == [(clip, *setting) for clip in range(CLIPS) for setting in settings]
    assert not any(row.failure for row in rows)


@pytest.mark.parametrize("method", ABLATION)
def test_a_row_is_what_the_passes_give(truth, rows, passes, method):
    settings = {} if method == "vggt" else {"mask_source": "mined", "mask_pairs": 2}
    row = only(rows, clip=1, method=method, **settings)
    made = assemble(passes, method=method)
    depth, poses, clip = np.asarray(made.depth[1]), np.asarray(made.camera_from_world[1]), Truth(*(a[1] for a in truth))
    scale = median_scale(depth, clip.depth)
    assert row.abs_rel == pytest.approx(depth_errors(depth, clip.depth).abs_rel, rel=1e-4)
    assert row.delta1 == pytest.approx(depth_errors(depth, clip.depth).delta1, abs=1e-3)
    for value, region in ((row.abs_rel_static, ~clip.dynamic_mask), (row.abs_rel_dynamic, clip.dynamic_mask)):
        assert value == pytest.approx(depth_errors(depth, clip.depth, region, scale=scale).abs_rel, rel=1e-4)
    assert row.rotation_error == pytest.approx(rotation_error(poses, clip.camera_from_world), rel=1e-3)
    assert row.centre_error == pytest.approx(centre_error(poses, clip.camera_from_world), rel=1e-3)
    assert row.centre_error_ratio == pytest.approx(row.centre_error / np.median(clip.depth[:, 3:]))
    of_points = point_distances(depth, np.asarray(made.intrinsics[1]), poses, clip)
    assert [row.point_distance, row.point_distance_first] == pytest.approx(of_points, rel=1e-3)
    pixels = np.asarray(upsample(passes.saliency, SIZE)[1])
    assert row.saliency_auc == pytest.approx(auc(pixels, clip.dynamic_mask), abs=1e-3)
    mined = np.asarray(passes.dynamic_mask[1])
    expected = None if method == "vggt" else pytest.approx(jaccard(mined, clip.dynamic_mask), abs=1e-3)
    assert row.mask_jaccard == expected


def test_a_result_is_scored_as_its_row(truth, rows, passes):
    clip, made = Truth(*(array[1] for array in truth)), assemble(passes, method="4dvggt-d")
    fields = {"depth": made.depth, "depth_confidence": made.confidence, "camera_from_world": made.camera_from_world}
    fields |= {"intrinsics": made.intrinsics, "saliency": passes.saliency, "dynamic_mask": passes.dynamic_mask}
    arrays = {name: np.asarray(array[1]) for name, array in fields.items()}
    of_clip = clip_fields(load_clip(clip.images, size=SIZE[1], patch=14))
    result = Reconstruction(**arrays, **of_clip, method="4dvggt-d", model_name="tiny", settings={})
    row = score_result(result, clip, "mined")
    assert (row.method, row.mask_source) == ("4dvggt-d", "mined")
    assert close(only(rows, clip=1, method="4dvggt-d", mask_source="mined", mask_pairs=2), row)
    with pytest.raises(InputError, match="the truth has depth of shape"):
        score_result(result, Truth(*(array[:2] for array in clip)), "mined")
    table = error_table([only(rows, clip=1, method="vggt")], replace(row, mask_source="pixels"))
    assert table.rows[-1][:2] == ("consistent", "pixels")
    assert "Depth and cameras fitted to the clip's pixels, compared with the first pass: rotation" in table.note


def point_distances(depth, intrinsics, poses, clip) -> list[float]:
    """Lift pixel by pixel, from the definition: aligned by all centres, and as seen from the first camera."""
    similarity = umeyama_sim3(checked_centres(poses), checked_centres(clip.camera_from_world))
    scale, distances = np.median(clip.depth[clip.depth > 0] / depth[clip.depth > 0]), []
    for frame, row, column in np.argwhere(clip.depth > 0):
        pixel, points, seen = np.array([column, row, 1.0]), [], []
        for z, K, pose in ((depth, intrinsics, poses), (clip.depth, clip.intrinsics, clip.camera_from_world)):
            local = z[frame, row, column] * (np.linalg.inv(K[frame]) @ pixel)
            points.append(pose[frame, :, :3].T @ (local - pose[frame, :, 3]))
            seen.append(pose[0] @ [*points[-1], 1])
        apart = similarity.apply(points[0][None])[0] - points[1], scale * seen[0] - seen[1]
        distances.append(np.linalg.norm(apart, axis=1))
    return np.mean(distances, axis=0).tolist()


def test_suppressing_nothing_is_the_plain_pass(rows):
    plain = only(rows, clip=0, method="vggt")
    for source in ("mined", "true"):
        setting = {"clip": 0, "method": "pose-decoupling", "mask_source": source}
        assert close(plain, only(rows, mask_pairs=0, **setting))
        assert plain.rotation_error != only(rows, mask_pairs=2, **setting).rotation_error
    assert all(row.mask_jaccard == 1 for row in rows if row.mask_source == "true")


def test_what_the_truth_leaves_undefined_is_none(model, truth):
    standing = np.tile(np.eye(3, 4), (CLIPS, FRAMES, 1, 1))
    still = truth._replace(dynamic_mask=np.zeros_like(truth.dynamic_mask), camera_from_world=standing)
    row = ladder(model, still, methods=["vggt"], batch_size=2)[0]
    undefined = (row.abs_rel_dynamic, row.saliency_auc, row.centre_error, row.centre_error_ratio, row.point_distance)
    assert undefined == (None,) * 5
    assert row.abs_rel_static == row.abs_rel
    assert row.rotation_error is not None
    assert row.failure == "the true cameras do not move; their centres cannot be aligned"


def test_options_of_other_methods_are_refused(model, truth):
    for name, value in {"method": "vggt", "mask": "matches", "refine_mask": True}.items():
        with pytest.raises(InputError, match=f"options have {name} "):
            ladder(model, truth, **{name: value})


def test_true_cameras_go_into_a_network_that_reads_them(model, truth):
    config = replace(TINY, image_size=42)
    reader, first = tiny_model(config), Truth(*(array[:1] for array in truth))
    rows = [ladder(reader, first, methods=["vggt"], known_cameras=known)[0] for known in (False, True)]
    cameras = encode_pose(jnp.asarray(first.camera_from_world), jnp.asarray(first.intrinsics), SIZE)
    images = jnp.asarray(first.images, jnp.float32)
    depth = np.asarray(forward(reader.params, images, config, cameras=cameras).depth)[0]
    expected = depth_errors(depth, first.depth[0], scale=median_scale(depth, first.depth[0])).abs_rel
    assert rows[1].abs_rel == pytest.approx(expected, rel=1e-4)
    assert rows[0].abs_rel != pytest.approx(expected, rel=1e-4)
    with pytest.raises(InputError, match="cameras are given, and this network reads none"):
        ladder(model, first, methods=["vggt"], known_cameras=True)


def test_a_model_gone_wrong_is_a_row_that_says_so(model, truth):
    broken = replace(model, params=jax.tree.map(lambda leaf: jax.device_put(np.full_like(leaf, np.nan)), model.params))
    row = ladder(broken, truth, methods=["vggt"], batch_size=2)[0]
    assert row.abs_rel is row.abs_rel_static is row.delta1 is row.rotation_error is row.saliency_auc is None
    for sentence in ("predicted depths are not finite", "camera poses have values that are not finite"):
        assert sentence in row.failure


@pytest.mark.parametrize(
    ("rotation", "centre", "abs_rel", "expected"),
    [
        (1.5, 0.01, 0.1, "rotation better, .*; centres better, 0.020 -> 0.010; AbsRel better"),
        (2.5, 0.02, 0.3, "rotation worse, 2.00° -> 2.50°; centres unchanged, .* worse"),
    ],
)
def test_words_follow_the_numbers(rows, rotation, centre, abs_rel, expected):
    first = replace(only(rows, clip=0, method="vggt"), rotation_error=2.0, centre_error_ratio=0.02, abs_rel=0.2)
    second = replace(first, method="4dvggt-d", mask_source="mined", abs_rel=abs_rel)
    second = replace(second, rotation_error=rotation, centre_error_ratio=centre)
    words = second_pass_in_words([first, second])
    assert re.match(f"Masks as in the paper, second pass on this clip: {expected}", words)
    assert second_pass_in_words([first]) == second_pass_in_words([first, replace(second, abs_rel=None)]) == ""
    assert error_table([first, second]).note.startswith(words)


def test_words_of_many_clips(rows, tmp_path):
    many = SecondPass(
        3, {"true": {"rotation_error": Change(-0.25, 0.144), "centre_error_ratio": Change(-0.001, 0.004)}}
    )
    write_second_pass(tmp_path / "file.json", many)
    assert read_second_pass(tmp_path / "file.json") == many
    assert many_in_words(many).startswith("Over 3 such clips")
    assert many_in_words(many).endswith("True masks: rotation by -25 ± 14 %, centres by +0 ± 0 %.")
    first = only(rows, clip=0, method="vggt")
    assert many_in_words(many) in error_table([first], many=many).note
    assert "centres unknown" in error_table([first], replace(first, centre_error_ratio=None)).note

"""Known geometry through the whole reconstruction: the same prediction, brought to what is known."""

import numpy as np
import pytest
from PIL import Image

from tests.shared.moving_ball import moving_ball
from vggtjax import Reconstruction, reconstruct, reconstruct_many
from vggtjax.errors import InputError
from vggtjax.pipeline.known.options import KnownGeometry


@pytest.mark.filterwarnings("ignore:the field of view")
def test_masks_intrinsics_and_scale_reach_the_result(model, clip, tmp_path):
    height, width = clip.source_size[0]
    sky = np.zeros((height, width), np.uint8)
    sky[: height // 2] = 255
    for name in clip.frame_names:
        Image.fromarray(sky).save(tmp_path / f"{name}.png")
    (tmp_path / "depths.csv").write_text(f"frame,x,y,depth\n1,{width / 2},{height - 1},3\n")
    K, depths = f"{1.2 * width},{1.2 * width},{width / 2},{height / 2}", str(tmp_path / "depths.csv")
    known = KnownGeometry(intrinsics=K, known_depths=depths, leave_out=tmp_path)
    plain = reconstruct(model, clip, method="vggt")
    made = reconstruct(model, clip, method="vggt", known=known)
    kept = made.depth[:, 28:]
    assert not made.depth[:, :28].any()
    np.testing.assert_allclose(kept / plain.depth[:, 28:], made.depth[1, 55, 28] / plain.depth[1, 55, 28], rtol=1e-5)
    assert made.depth[1, 55, 28] == pytest.approx(3)
    np.testing.assert_allclose(made.intrinsics[:, [0, 1], [0, 1]], 1.2 * 56, rtol=1e-6)
    assert made.settings["known"]["known_depths"] == depths
    assert set(made.known_facts) == {"left out", "intrinsics", "scale"}


@pytest.mark.filterwarnings("ignore:the field of view")
def test_a_batch_takes_what_its_clips_share(model, tmp_path):
    frames = (255 * np.asarray(moving_ball(3))).astype(np.uint8)
    (done,) = reconstruct_many(model, {"ball": frames}, tmp_path, method="vggt", known=KnownGeometry(shared_focal=True))
    assert done.status == "done"
    intrinsics = Reconstruction.load(tmp_path / "ball").intrinsics
    np.testing.assert_allclose(intrinsics, intrinsics[:1].repeat(3, axis=0))
    with pytest.raises(InputError, match="--baseline is of one clip"):
        next(reconstruct_many(model, {}, tmp_path, known=KnownGeometry(baseline="0,1,2")))

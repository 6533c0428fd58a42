"""Cameras that turn as features of painted pictures do, and what leaves the prediction as it is."""

from unittest.mock import Mock

import numpy as np
import pytest
from skimage.feature import SIFT

from tests.shared.corner import corner_result, make_corner, paint
from vggtjax.cameras import camera_centres
from vggtjax.pipeline.refinement.cells import cells_of, grey_pictures
from vggtjax.pipeline.refinement.dense import PREDICTED, ROUNDS, adjust_to_pixels
from vggtjax.pipeline.refinement.turns import turned_by_features
from vggtjax.research.evaluation.metrics.trajectory import rotation_error


@pytest.fixture(scope="module")
def turning():
    """Cameras that turn at one place, and their pictures."""
    corner = make_corner(4, 0.7)
    poses = corner.camera_from_world.copy()
    poses[:, :, 3] = -poses[:, :, :3] @ camera_centres(poses)[0]
    corner = corner._replace(camera_from_world=poses)
    return corner, paint(corner)


def cells_and_pictures(corner, pictures, degrees):
    result = corner_result(corner, degrees=degrees, share=0)
    cells = cells_of(result)
    return cells, grey_pictures(result, iter(pictures), cells.grid)


def test_turns_are_found_and_centres_stay(turning):
    corner, pictures = turning
    cells, grey = cells_and_pictures(corner, pictures, degrees=40)
    found = turned_by_features(cells, grey)
    assert found is not None
    assert rotation_error(found, corner.camera_from_world) < 0.3
    np.testing.assert_allclose(camera_centres(found), camera_centres(cells.cameras.camera_from_world), atol=1e-5)
    moving = cells._replace(is_static=np.zeros_like(cells.is_static))
    assert turned_by_features(moving, grey) is None


def test_a_neighbour_without_features_turns_as_predicted(turning):
    corner, pictures = turning
    cells, grey = cells_and_pictures(corner, pictures, degrees=40)
    grey = np.concatenate([grey[:3], np.full_like(grey[3:], 99)])
    found = turned_by_features(cells, grey)
    assert found is not None
    before = cells.cameras.camera_from_world[:, :, :3]
    np.testing.assert_allclose(found[3, :, :3] @ found[2, :, :3].T, before[3] @ before[2].T, atol=1e-5)
    assert rotation_error(found[:3], corner.camera_from_world[:3]) < 0.3


def test_turns_as_predicted_are_no_second_start(turning):
    assert turned_by_features(*cells_and_pictures(*turning, degrees=0)) is None


@pytest.mark.parametrize("error", [None, ValueError])
def test_pictures_without_features_are_no_second_start(turning, monkeypatch, error):
    cells, grey = cells_and_pictures(*turning, degrees=40)
    if error is None:
        grey = np.full_like(grey, 99)
    else:  # scikit-image computes the orientation of a feature with flat surroundings from 0 / 0
        monkeypatch.setattr(SIFT, "detect_and_extract", Mock(side_effect=error))
    assert turned_by_features(cells, grey) is None


def test_a_second_start_that_is_wrong_loses(turning):
    cells, grey = cells_and_pictures(*turning, degrees=2)
    wrong = cells_and_pictures(*turning, degrees=40)[0].cameras.camera_from_world
    alone, both = (adjust_to_pixels(cells, grey, PREDICTED, ROUNDS[:1], starts=starts) for starts in ((), (wrong,)))
    np.testing.assert_array_equal(both.camera_from_world, alone.camera_from_world)

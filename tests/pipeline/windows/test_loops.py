"""Finding loops: by features alone, in windows far apart, each place once."""

import numpy as np

from vggtjax.pipeline.windows.loops import described_frames, find_loops, frames_around
from vggtjax.pipeline.windows.plan import plan_windows

WINDOWS = plan_windows(80, 8, 2)


def features_of(angle):
    """Return features of each window's described frames, of a camera that turns by `angle` of the frame's number."""
    places = [np.array([angle(frame) for frame in described_frames(window)]) for window in WINDOWS]
    return [np.stack([np.cos(place), np.sin(place), np.full(len(place), 5.0)], axis=1) for place in places]


def test_a_camera_that_comes_back_is_found_where_it_does():
    found = find_loops(features_of(lambda frame: 2 * np.pi * frame / 72), WINDOWS, most=10)
    assert found
    for loop in found:
        assert 60 <= loop.second_frame - loop.first_frame <= 80  # once around
        assert loop.first_frame in WINDOWS[loop.first]
        assert loop.second_frame in WINDOWS[loop.second]


def test_a_camera_that_goes_on_closes_no_loop():
    assert find_loops(features_of(lambda frame: 1.2 * np.pi * frame / 80), WINDOWS, most=10) == []
    assert frames_around(19, range(10, 20), 4) == range(16, 20)  # frames around a loop's stay in its window


def test_no_more_than_asked_for_and_each_place_once():
    around = features_of(lambda frame: 2 * np.pi * frame / 20)
    found = find_loops(around, WINDOWS, most=100)
    assert find_loops(around, WINDOWS, most=2) == found[:2]
    pairs = [(loop.first, loop.second) for loop in found]
    assert all(max(abs(a - c), abs(b - d)) > 2 for i, (a, b) in enumerate(pairs) for c, d in pairs[:i])

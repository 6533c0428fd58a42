import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vggtjax.cameras import Similarity
from vggtjax.errors import InputError
from vggtjax.pipeline.windows.graph import Edge, solve_graph
from vggtjax.pipeline.windows.loops import described_frames, find_loops, frames_around
from vggtjax.pipeline.windows.plan import plan_windows


def random_similarity(generator, size=1.0) -> Similarity:
    rotation = Rotation.from_rotvec(size * generator.normal(size=3)).as_matrix()
    return Similarity(float(np.exp(size * generator.normal())), rotation, size * generator.normal(size=3))


def edges_of(worlds, pairs, generator=None, noise=0.0):
    def between(i, j):
        exact = worlds[i].inverse().after(worlds[j])
        return exact if generator is None else exact.after(random_similarity(generator, noise))

    return [Edge(i, j, between(i, j)) for i, j in pairs]


def worst(found, worlds):
    """Return the largest distance of points of a window from where they should be, in the first window's world."""
    first = found[0].after(worlds[0].inverse())
    points = np.eye(3)
    return max(np.abs(a.apply(points) - first.after(b).apply(points)).max() for a, b in zip(found, worlds, strict=True))


def ring(count):
    """Worlds along a circle, so that the last lies beside the first."""
    turns = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return [
        Similarity(1.0, Rotation.from_rotvec([0, turn, 0]).as_matrix(), 4 * np.array([np.sin(turn), 0, np.cos(turn)]))
        for turn in turns
    ]


@pytest.mark.parametrize("loop", [(), ((0, 5), (1, 4))])
def test_exact_edges_give_exact_worlds(loop):
    generator = np.random.default_rng(0)
    worlds = [random_similarity(generator) for _ in range(6)]
    edges = edges_of(worlds, [*((i, i + 1) for i in range(5)), *loop])
    assert worst(solve_graph(6, edges, [1.0] * 6), worlds) < 1e-8


def test_a_loop_takes_the_drift_back():
    generator, count = np.random.default_rng(1), 12
    worlds = ring(count)
    chain = edges_of(worlds, [(i, i + 1) for i in range(count - 1)], generator, 0.02)
    closed = chain + edges_of(worlds, [(0, count - 1)])
    drifted, solved = (worst(solve_graph(count, edges, [1.0] * count), worlds) for edges in (chain, closed))
    assert solved < 0.6 * drifted


def test_a_wrong_loop_does_not_bend_everything():
    generator = np.random.default_rng(2)
    worlds = ring(12)
    pairs = [*((i, i + 1) for i in range(11)), (0, 11), (1, 10), (2, 9)]
    wrong = Edge(3, 8, random_similarity(generator, 1.0))
    error = worst(solve_graph(12, [*edges_of(worlds, pairs), wrong], [1.0] * 12), worlds)
    assert error < 0.25  # of a ring of diameter 8; the wrong edge asks for several


def test_a_window_without_an_edge():
    with pytest.raises(InputError, match="window 2 is joined to no other"):
        solve_graph(3, edges_of(ring(3), [(0, 1)]), [1.0] * 3)


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

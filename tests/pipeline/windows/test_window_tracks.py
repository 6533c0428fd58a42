"""Points followed from window to window, with a double of the tracker that knows how all places move."""

import numpy as np
import pytest
from PIL import Image

from tests.shared.tiny import tiny_model
from vggtjax import load_clip, reconstruct
from vggtjax.clips.masks import masks_digest
from vggtjax.clips.media.sampling import Sampling
from vggtjax.clips.preprocessing import Fitter
from vggtjax.clips.queries import Queries, check_queries, parse_queries
from vggtjax.clips.sources import open_source
from vggtjax.errors import ClipError, InputError
from vggtjax.options import Options
from vggtjax.pipeline.windows.frames import SeenFrames, window_clips
from vggtjax.pipeline.windows.plan import Windows, plan_windows
from vggtjax.pipeline.windows.run import LongRun, reconstruct_long, tools_of
from vggtjax.pipeline.windows.tracks import Tracked, TrackStart, follow_points
from vggtjax.results.saving import Saving

FRAMES = 50
WINDOWS = plan_windows(FRAMES, 16, 6)
HIDDEN = (43.0, 45.0)  # columns behind a post
POINTS = Queries(
    np.array([[2.5, 3], [70, 20], [30, 9], [55.5, 31], [5, 0.5]]), np.array([0, 0, 23, 49, 24])
)  # given in the first frame, in the middle and in the last one


def truth(queries) -> np.ndarray:
    """Return where points are in all frames [S, Q, 2]: each row of the picture moves at a speed of its own."""
    return moved(queries.points, np.arange(FRAMES)[:, None] - queries.frames)


def moved(points, frames):
    x, y = np.broadcast_to(points, (*frames.shape[:1], *points.shape)).transpose(2, 0, 1)
    return np.stack([x + frames * (0.5 + y / 100), y], axis=-1)


def is_seen(positions):
    return (positions[..., 0] < HIDDEN[0]) | (positions[..., 0] > HIDDEN[1])


class Tracker:
    """Follows every point exactly, unless it starts behind the post; in the window `wrong` it loses all of them."""

    def __init__(self, *, always=False, wrong=None):
        self.always, self.wrong, self.runs = always, wrong, []

    def __call__(self, images, starts):
        found, first = [], int(images[0, 0, 0, 0])
        for frame, places in starts:
            self.runs.append((first, frame, len(places)))
            later = np.arange(len(images))[:, None] - frame
            positions = moved(places, later)
            lost = np.where(is_seen(places) | self.always, 0, 7)[:, None]
            seen = (is_seen(positions) | self.always).astype(np.float32)
            sure = np.ones_like(seen)
            if first == self.wrong:
                positions, sure = positions + 20 * (later > 0)[..., None], np.where(later > 0, 0, sure)
            found.append(Tracked((positions + lost).astype(np.float32), seen, sure))
        return found


def followed(tracker, queries=POINTS):
    Q = len(queries.frames)
    into = Tracked(*(np.zeros((FRAMES, Q, *more), np.float32) for more in ((2,), (), ())))
    images = np.broadcast_to(np.arange(FRAMES, dtype=np.float32)[:, None, None, None], (FRAMES, 2, 2, 3))
    steps: list[tuple[int, int | None]] = []
    follow_points(
        queries,
        WINDOWS,
        lambda number: images[WINDOWS[number].start : WINDOWS[number].stop],
        tracker,
        into,
        np.zeros((FRAMES, Q), np.float32),
        lambda done, total: steps.append((done, total)),
    )
    assert [done for done, _ in steps] == list(range(1, len(steps) + 1))
    assert steps[-1][0] == steps[-1][1]
    return into


def test_points_of_any_frame_are_followed_through_all_windows_both_ways():
    tracker, true = Tracker(), truth(POINTS)
    found = followed(tracker)
    assert np.abs(found.positions - true).max() < 1e-4
    assert (found.visibility == is_seen(true)).mean() > 0.97  # windows differ only where rounding decides
    assert np.abs(found.confidence - 1).max() < 1e-6
    assert np.array_equal(found.positions[POINTS.frames, np.arange(5)], POINTS.points)


def test_points_of_the_first_frame_cost_one_run_of_the_tracker_for_each_window():
    tracker = Tracker(always=True)
    followed(tracker, Queries(np.full((9, 2), 60.0), np.zeros(9, np.int64)))
    assert tracker.runs == [(window.start, 0, 9) for window in WINDOWS]


def test_points_are_taken_over_where_they_are_seen(monkeypatch):
    """The second point is behind the post in the first frame that two windows share; taken over there, it is lost."""
    behind = 44 - 0.6 * WINDOWS[1].start
    queries = Queries(np.array([[70, 10], [behind, 10]]), np.array([0, 0]))
    assert np.abs(followed(Tracker(), queries).positions - truth(queries)).max() < 1e-4
    monkeypatch.setattr("vggtjax.pipeline.windows.tracks._SEEN", -1.0)
    assert np.abs(followed(Tracker(), queries).positions - truth(queries)).max() > 1


def test_a_window_that_lost_its_points_has_no_say_in_shared_frames():
    """The second window is unsure after the frame in which it takes points over; frames of the first one stay right."""
    queries = Queries(np.array([[1.0, 5.0], [2.0, 30.0]]), np.array([0, 0]))
    off = np.abs(followed(Tracker(always=True, wrong=WINDOWS[1].start), queries).positions - truth(queries))
    assert off[: WINDOWS[0].stop].max() < 0.2  # 20 pixels apart, for a thousandth of the weight
    assert off[WINDOWS[0].stop].max() > 10


@pytest.mark.proof
def test_the_network_follows_points_as_in_a_clip_that_is_run_at_once():
    model, points = tiny_model(), np.array([[10, 20], [40.5, 30]], np.float32)
    clip = load_clip(np.random.default_rng(1).random((4, 56, 56, 3), np.float32), size=56)
    at_once = reconstruct(model, clip, method="vggt", tracks=Queries(points, np.array([2, 2])))
    follow = tools_of(model, Options("vggt")).follow
    assert follow is not None
    assert at_once.track_positions is not None
    found = follow(clip.images, [TrackStart(2, points)])[0]
    assert np.abs(found.positions - at_once.track_positions).max() < 1e-4
    assert np.abs(found.visibility - at_once.track_visibility).max() < 1e-5


@pytest.mark.proof
def test_points_of_a_file_are_followed_in_windows(tmp_path):
    (tmp_path / "points.csv").write_text("x,y,frame\n10,20,0\n40.5,30,8\n")
    run = LongRun(fitter=Fitter(size=56), tracks=str(tmp_path / "points.csv"))
    run = run._replace(saving=Saving(only=("cameras",)))
    images = np.random.default_rng(2).random((9, 56, 56, 3), np.float32)
    result = reconstruct_long(tiny_model(), images, tmp_path / "out", Windows(6, 2), long_run=run, method="vggt")
    assert result.track_positions is not None
    assert result.track_positions[[0, 8], [0, 1]].tolist() == [[10, 20], [40.5, 30]]
    assert (tmp_path / "out" / "tracks.npz").is_file()


def test_given_masks_are_a_folder_or_a_pattern_and_windows_of_other_masks_are_not_used(tmp_path):
    masks, out = tmp_path / "masks", tmp_path / "out"
    masks.mkdir()
    images = np.random.default_rng(3).random((6, 56, 56, 3), np.float32)
    run = LongRun(fitter=Fitter(size=56), saving=Saving(only=("cameras",)))

    def reconstructed(given):
        return reconstruct_long(tiny_model(), images, out, Windows(4, 2), long_run=run, masks=given)

    with pytest.raises(ClipError, match="masks"):
        reconstructed(str(masks / "*.png"))
    assert not out.exists()
    for frame in range(6):
        Image.fromarray(np.full((56, 56), 255 * (frame % 2), np.uint8)).save(masks / f"{frame:06d}.png")
    digest = masks_digest(str(masks / "*.png"))
    assert reconstructed(str(masks / "*.png")).dynamic_mask.mean(axis=(1, 2)).tolist() == [0, 1, 0, 1, 0, 1]
    Image.fromarray(np.full((56, 56), 255, np.uint8)).save(masks / "000000.png")
    assert masks_digest(str(masks / "*.png")) != digest


def test_points_in_frames_of_another_size_than_the_first_are_checked_in_their_own(tmp_path):
    (tmp_path / "points.csv").write_text("x,y,frame\n500,300,8\n")
    pictures = [np.zeros((48, 64, 3), np.uint8)] * 5 + [np.zeros((480, 640, 3), np.uint8)] * 5
    cut, fitter = plan_windows(10, 6, 2), Fitter(size=56, mode="pad")
    clips = list(window_clips(open_source(pictures), Sampling(), fitter, cut))
    check_queries(str(tmp_path / "points.csv"), clips[0], 10)
    seen = SeenFrames()
    for clip, window in zip(clips, cut, strict=True):
        seen.add(clip, window)
    queries = parse_queries(str(tmp_path / "points.csv"), seen.clip())
    assert np.abs(queries.points - [[500 * 56 / 640, 300 * 56 / 640 + 7]]).max() < 0.1
    (tmp_path / "points.csv").write_text("x,y,frame\n500,300,2\n")
    with pytest.raises(InputError, match="lies outside what the model sees of frame 2, a picture of 64 x 48"):
        check_queries(str(tmp_path / "points.csv"), clips[0], 10)

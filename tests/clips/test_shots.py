"""Clips that are no clip: black beginnings, flashes, cuts; and cameras that move fast, which are none of these."""

import logging

import numpy as np
import pytest
from PIL import Image

from vggtjax import Reconstruction, load_clip
from vggtjax.clips.media.sampling import Sampling
from vggtjax.clips.preprocessing import Fitter
from vggtjax.clips.shots import find_shots, look_at, shot_samplings
from vggtjax.clips.sources import open_source
from vggtjax.errors import ClipError, InputError
from vggtjax.interface.commands import main as cli
from vggtjax.pipeline.windows.frames import window_clips

SIDE = 96


def place(seed, frames, step=3):
    """Return frames of a camera that moves over a coloured picture of its own, by `step` pixels a frame."""
    rng = np.random.default_rng(seed)
    coarse = Image.fromarray(rng.integers(0, 255, (24, 24, 3), np.uint8))
    tint = rng.uniform(0.3, 1, 3)
    wall = np.asarray(coarse.resize((400, 400), Image.Resampling.BICUBIC)) * tint
    starts = range(0, step * frames, step)
    return [wall[at : at + SIDE, 2 * at : 2 * at + SIDE].astype(np.uint8) for at in starts]


BLACK, GREY = np.zeros((SIDE, SIDE, 3), np.uint8), np.full((SIDE, SIDE, 3), 120, np.uint8)
A, B = place(1, 6), place(2, 6)
NIGHT = [(picture // 16).astype(np.uint8) for picture in A]  # within 16 of 255
HALVES = np.concatenate([np.full((SIDE, 48, 3), (200, 0, 0)), np.full((SIDE, 48, 3), (0, 200, 0))], axis=1)


def lit(pictures, *numbers):
    """Return the pictures, those of these numbers as in a flash."""
    bright = [(255 - (255 - picture.astype(int)) // 3).astype(np.uint8) for picture in pictures]
    return [bright[i] if i in numbers else picture for i, picture in enumerate(pictures)]


def grey(pictures):
    return [np.repeat(picture.mean(axis=-1, keepdims=True), 3, axis=-1).astype(np.uint8) for picture in pictures]


FLASH = lit(A, 3)
LONG = place(1, 9)


@pytest.mark.parametrize(
    ("pictures", "blank", "flashes", "shots"),
    [
        (A, (), (), [(0, 6)]),
        (place(3, 8, step=15), (), (), [(0, 8)]),  # a fast camera
        ([A[0], B[0], place(4, 1)[0]], (), (), [(0, 3)]),  # pictures from afar are no shots
        ([BLACK, BLACK, *A], (0, 1), (), [(2, 8)]),
        ([*A, GREY], (6,), (), [(0, 6)]),
        ([*A[:3], BLACK, *A[3:]], (3,), (), [(0, 7)]),
        (FLASH, (), (3,), [(0, 6)]),
        (lit(LONG, 4, 5), (), (4, 5), [(0, 9)]),
        (lit(LONG, 0), (), (0,), [(1, 9)]),
        (lit(LONG, 8), (), (8,), [(0, 8)]),
        (NIGHT, (), (), [(0, 6)]),
        ([HALVES.astype(np.uint8)] * 3, (), (), [(0, 3)]),
        ([*grey(place(1, 6, step=1)), *grey(place(2, 6, step=1))], (), (), [(0, 6), (6, 12)]),
        ([*A[:3], B[0], *A[3:]], (), (3,), [(0, 7)]),  # a picture of another place
        ([*A, *B], (), (), [(0, 6), (6, 12)]),
        ([*A, BLACK, *B], (6,), (), [(0, 6), (7, 13)]),
        ([*A, *B, *place(5, 4)], (), (), [(0, 6), (6, 12), (12, 16)]),
        ([(0.5 * picture).astype(np.uint8) if i > 3 else picture for i, picture in enumerate(A)], (), (), [(0, 6)]),
        ([BLACK, GREY], (0, 1), (), []),
    ],
)
def test_frames_that_are_no_part_of_the_scene(pictures, blank, flashes, shots):
    found = find_shots([look_at(Image.fromarray(picture)) for picture in pictures])
    assert (found.blank, found.flashes) == (blank, flashes)
    assert [(shot.start, shot.stop) for shot in found.shots] == shots


def test_they_are_named_with_what_to_do(caplog):
    with caplog.at_level(logging.WARNING):
        load_clip([BLACK, *A, *B], start=0, size=98)
    assert "frame 0 is of one colour" in caplog.text
    assert "--skip 0" in caplog.text
    assert "2 shots: frames 1-6, 7-12" in caplog.text
    assert "--start 7 --max-frames 6" in caplog.text
    load_clip([BLACK, *A, *B], start=1, stride=2, size=98)
    assert "frames 1-5, 7-11" in caplog.text  # numbers are those of the source


def test_numbers_of_pictures_with_times_are_places_in_the_folder(tmp_path, caplog):
    for number, picture in enumerate([*A, *B]):
        Image.fromarray(picture).save(tmp_path / f"{1403636579763555584 + number * 50_000_000}.png")
    (first, second) = shot_samplings(open_source(tmp_path), Sampling(fps=10, skip="0"))
    assert (first.start, second.start, second.max_frames, first.skip) == (2, 6, 3, "0")
    assert "frames 2-4, 6-10" in caplog.text


def test_clips_in_which_nothing_can_be_seen():
    with pytest.raises(ClipError, match="all 2 frames are of one colour"):
        shot_samplings(open_source([BLACK, GREY]), Sampling())


def test_each_finding_of_a_long_clip_is_said_when_it_is_read(caplog):
    source = open_source([BLACK, *A, *B])
    windows = window_clips(source, Sampling(), Fitter("crop", 98, 14), [range(5), range(3, 9), range(7, 13)])
    next(windows)
    assert "frame 0 is of one colour" in caplog.text
    assert len(caplog.messages) == 1
    list(windows)
    assert [("of one colour" in text, "2 shots" in text) for text in caplog.messages] == [(True, False), (False, True)]


@pytest.mark.parametrize("stride", [None, 2])
def test_each_shot_is_taken_by_its_own_numbers(stride):
    source = open_source([BLACK, *FLASH, *B])
    samplings = shot_samplings(source, Sampling(0, stride))
    taken = [[frame.name for frame in source.frames(sampling)] for sampling in samplings]
    every = [[1, 2, 3, 5, 6], [*range(7, 13)]] if stride is None else [[2, 6], [8, 10, 12]]
    assert taken == [[f"{number:06d}" for number in numbers] for numbers in every]


def test_frames_to_leave_out():
    clip = load_clip(A, skip="0-1, 4", max_frames=2, size=98)
    assert clip.frame_names == ["000002", "000003"]
    for text in ("1-", "b", "3-1", "-2", "1,,2"):
        with pytest.raises(InputError, match=r"skip is .* expected numbers of frames, such as 0-2,17"):
            Sampling(skip=text)
    with pytest.raises(ClipError, match=r"skip is .0-99. and leaves no frame of 6"):
        load_clip(A, skip="0-99")


@pytest.mark.usefixtures("tiny_demo")
@pytest.mark.filterwarnings("ignore:the field of view")
def test_split_writes_a_result_of_each_shot_and_blank_frames_have_the_lowest_confidence(tmp_path, capsys):
    for number, picture in enumerate([*A[:3], BLACK, *B[:3]]):
        Image.fromarray(picture).save(tmp_path / f"{number}.png")
    call = ["reconstruct", str(tmp_path / "*.png"), "--model", "demo", "--method", "vggt", "--no-consistent-depth"]
    assert cli.main([*call, "--out", str(tmp_path / "whole")]) == 0
    confidence = Reconstruction.load(tmp_path / "whole").depth_confidence
    assert (confidence[3] == confidence.min()).all()
    assert cli.main([*call, "--shots", "split", "--out", str(tmp_path / "split")]) == 0
    assert sorted(folder.name for folder in (tmp_path / "split").iterdir()) == ["shot_1", "shot_2"]
    assert "shot_2 of 2: from frame 4, 3 frames" in capsys.readouterr().err
    assert cli.main([*call, "--shots", "split", "--tracks", "grid:3", "--out", str(tmp_path / "no")]) == 2
    assert "--shots split and --tracks exclude each other" in capsys.readouterr().err


def test_frames_that_are_dark_as_a_whole_are_warned_of(caplog):
    dark = [np.stack(A).astype(np.uint16) * 16, (np.stack(A) / 255 / 255).astype(np.float32), [a // 16 for a in A]]
    bright = [np.stack(A), [*dark[2][1:], A[0]], np.zeros_like(np.stack(A))]  # zeros are of one colour
    for frames, is_dark in (*((frames, True) for frames in dark), *((frames, False) for frames in bright)):
        caplog.clear()
        load_clip(frames, mode="pad", size=112)  # with white around
        assert ("the brightest pixel of all frames has" in caplog.text) == is_dark

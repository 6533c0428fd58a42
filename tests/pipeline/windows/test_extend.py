"""A finished result that grows: exact paths, old frames bit by bit, stopped runs, and what is refused."""

import dataclasses
import functools

import numpy as np
import pytest

from tests.pipeline.windows import walk as walks
from tests.pipeline.windows.walk import CONFIG, FRAMES, movers, walk, window_result
from tests.shared.contents import contents
from vggtjax.cameras import checked_centres, umeyama_sim3, unproject
from vggtjax.clips.clip import read_clip
from vggtjax.clips.media.sampling import Sampling
from vggtjax.clips.sources import open_source
from vggtjax.errors import InputError
from vggtjax.options import Options
from vggtjax.pipeline.windows import extend as extending
from vggtjax.pipeline.windows.extend import grow, options_of
from vggtjax.pipeline.windows.growth import PlaceError
from vggtjax.pipeline.windows.overlap import Places, choose_anchors, thinned
from vggtjax.pipeline.windows.plan import Extending
from vggtjax.pipeline.windows.run import run_windows
from vggtjax.pipeline.windows.store import WindowStore
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.results.result import ARRAYS

NOTHING = np.zeros((FRAMES, CONFIG.height, CONFIG.width), bool)
HOW = Extending(window=16, anchors=4)


def part_of_walk(frames, images=None):
    fitter = walks.plan_of().fitter
    clip = read_clip(open_source(np.asarray(walk().images if images is None else images)[frames]), Sampling(), fitter)
    return dataclasses.replace(clip, frame_names=[f"{frame:06d}" for frame in np.arange(FRAMES)[frames]])


@functools.cache
def places():
    """Return features of each frame by its pixels: waves of where the points of its patches lie in the world."""
    truth = walk()
    points = unproject(truth.depth, truth.intrinsics, truth.camera_from_world, pixel_offset=0.5)[:, 2::4, 2::4]
    directions = np.random.default_rng(3).normal(scale=2, size=(3, 64)) / np.median(truth.depth)
    waves = np.sin(points.reshape(FRAMES, -1, 3) @ directions + np.arange(64))
    return {
        np.round(255 * image).astype(np.uint8).tobytes(): each for image, each in zip(truth.images, waves, strict=True)
    }


def features(images):
    keys = [np.round(255 * image).astype(np.uint8).tobytes() for image in images]
    grid = (CONFIG.height // 4, CONFIG.width // 4)
    noise = np.random.default_rng(len(keys)).normal(size=(grid[0] * grid[1], 64))
    return thinned(np.stack([places().get(key, noise) for key in keys]), grid)


def joined(result, clip, run, store=None):
    tools = walks.tools_of(run)._replace(patches=features)
    return grow(result, clip, list(clip.frame_names), tools, HOW, Options(), store)


def exact(clip):
    return window_result(clip, 0, NOTHING)


def error_of(result, frames) -> float:
    """Return the largest distance of a camera from the truth after Sim(3), as a share of the path's extent."""
    found, true = (checked_centres(poses) for poses in (result.camera_from_world, walk().camera_from_world[frames]))
    return np.linalg.norm(umeyama_sim3(found, true).apply(found) - true, axis=1).max() / np.ptp(true, axis=0).max()


@pytest.mark.parametrize("backwards", [False, True])
def test_exact_windows_continue_a_result_exactly_and_its_frames_stay(backwards):
    old, new = part_of_walk(slice(0, 30)), part_of_walk(slice(None, 29, -1) if backwards else slice(30, None))
    moving = movers()
    result = window_result(old, 1, moving)
    both = joined(result, new, lambda clip: window_result(clip, 2, moving, 0.03))
    frames = [int(name) for name in both.frame_names]
    assert frames == [*range(30), *(reversed(range(30, 60)) if backwards else range(30, 60))]
    assert error_of(both, frames) < 1e-5
    for name in ARRAYS:
        if getattr(result, name) is not None and name != "timestamps":
            assert np.array_equal(getattr(both, name)[:30], getattr(result, name)), name
    scale = np.median(result.depth / walk().depth[:30])
    still = ~moving[frames]
    assert np.abs(both.depth / (scale * walk().depth[frames]) - 1)[still].max() < 1e-4
    facts = both.settings["extended"][0]
    assert (facts["first"], facts["frames"], len(facts["windows"])) == (30, 30, 3)
    assert all(window["degrees"] < 0.01 and window["distance"] < 1e-4 for window in facts["windows"])
    joins = [set(window["residuals"]) for window in facts["windows"]]
    assert sum("0" in nodes for nodes in joins) >= 2  # the walk comes back to the result: a loop is closed
    assert any(len(nodes) > 1 for nodes in joins)


def test_masks_of_added_frames_are_named_where_they_were_made_otherwise():
    given = dataclasses.replace(exact(part_of_walk(slice(0, 30))), settings={"masks": "given"})
    new = part_of_walk(slice(30, 45))

    def mined(clip):
        return dataclasses.replace(exact(clip), settings={"masks": "mined"})

    both = joined(given, new, mined)
    assert both.settings["masks"] == "given; mined in added frames"
    assert given.settings["masks"] == "given"
    again = joined(both, part_of_walk(slice(45, None)), mined)
    assert again.settings["masks"] == both.settings["masks"]
    assert "masks" not in joined(exact(part_of_walk(slice(0, 30))), new, exact).settings


def test_a_result_of_windows_in_metres_grows(tmp_path):
    """Its arrays are mapped files, of which nothing is written to."""
    tools = walks.tools_of(exact)._replace(patches=features)
    run_windows(np.asarray(walk().images)[:40], tmp_path, walks.windows_of(), walks.plan_of(), tools, walks.SETTINGS)
    before, result = contents(tmp_path), Reconstruction.load(tmp_path)
    result = dataclasses.replace(result, settings=result.settings | {"known": {"lengths": "metre"}})
    both = joined(result, part_of_walk(slice(40, None)), exact)
    assert error_of(both, slice(None)) < 1e-5
    assert both.length_unit == "metre"
    assert contents(tmp_path) == before


def test_a_stopped_run_goes_on(tmp_path):
    result, new, calls = exact(part_of_walk(slice(0, 30))), part_of_walk(slice(30, None)), []

    def run(clip, last=9):
        if len(calls) == last:
            raise KeyboardInterrupt
        calls.append(clip.frame_names)
        return exact(clip)

    with pytest.raises(KeyboardInterrupt):
        joined(result, new, lambda clip: run(clip, 2), WindowStore(tmp_path, {}))
    both = joined(result, new, run, WindowStore(tmp_path, {}))
    assert len(calls) == len({tuple(names) for names in calls}) == 3  # each window was run once
    assert error_of(both, slice(None)) < 1e-5


def test_frames_that_lead_to_the_place_are_run_first():
    """The new clip begins on the far side of the walk and comes to the frames of the result."""
    result, new = exact(part_of_walk(slice(0, 20))), part_of_walk(slice(59, 19, -1))
    far = Places.of(features(result.images / np.float32(255))[0], CONFIG.width // 4)
    overlaps = far.overlaps(features(new.images)[0]).max(axis=1)
    bound = float(np.sort(overlaps)[-12])  # the part in the middle shows nothing that the result shows
    tools = walks.tools_of(exact)._replace(patches=features)
    how = Extending(window=16, anchors=4, least_overlap=bound)
    both = grow(result, new, list(new.frame_names), tools, how, Options())
    assert error_of(both, [int(name) for name in both.frame_names]) < 1e-5


def test_what_cannot_be_added_is_refused_in_a_sentence():
    result, new = exact(part_of_walk(slice(0, 30))), part_of_walk(slice(30, None))
    noise = np.random.default_rng(0).random((FRAMES, CONFIG.height, CONFIG.width, 3))
    one = np.where((np.arange(FRAMES) == 40)[:, None, None, None], noise, walk().images)
    still = np.arange(30)[:, None, None] < 2
    whole = dataclasses.replace(result, dynamic_mask=np.broadcast_to(~still, result.depth.shape))

    def bent(clip):
        window = exact(clip)
        return dataclasses.replace(window, depth=window.depth * np.linspace(0.2, 3, len(clip))[:, None, None])

    for old, clip, run, sentence in (
        (
            result,
            part_of_walk(slice(30, None), noise),
            exact,
            "no known frame shows the place of .* 000030 and 29 more",
        ),
        (result, part_of_walk(slice(30, None), one), exact, "shows the place of the new frame 000040"),
        (whole, new, exact, "2 of 30 known frames show enough of what stands still"),
        (result, new, lambda clip: window_result(clip, 0, ~NOTHING), "too little that stands still in both"),
        (result, new, bent, r"anchors differ by \d+% of the depth, more than 20%"),
    ):
        with pytest.raises(PlaceError, match=sentence):
            joined(old, clip, run)


def test_anchors_cover_the_new_frames_and_spread_over_the_path():
    overlaps = np.full((2, 10), 0.1)
    overlaps[0, 1:4], overlaps[1, 8] = (0.6, 0.9, 0.6), 0.7
    centres, usable = np.arange(10)[:, None] * np.ones(3), np.ones(10, bool)
    assert {2, 8} <= set(choose_anchors(overlaps, centres, usable, 3))
    assert choose_anchors(overlaps, centres, usable & (np.arange(10) != 2), 8) == [1, 3, 8]
    assert len(choose_anchors(np.full((1, 10), 0.5), centres, usable, 4)) == 4
    one = np.full((1, 10), 0.1)
    one[0, 5] = 0.8
    assert len(choose_anchors(one, centres, usable, 8)) == 3  # the next best, where fewer than three overlap enough


def test_overlap_is_one_for_the_same_frame_and_ignores_the_order_of_patches():
    patches, columns = features(np.asarray(walk().images[:6]))
    places = Places.of(patches, columns)
    assert np.allclose(np.diag(places.overlaps(patches)), 1, atol=1e-5)
    assert np.allclose(places.overlaps(patches[:, ::-1]), places.overlaps(patches), atol=1e-5)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"model_name": "another"}, "is of the model 'another' and 'tiny' is given"),
        ({"settings": {"patch": 14, "missing": ["images"]}}, "has no images"),
        ({"settings": {"patch": 14}}, "has patches of 14 pixels; expected 8"),
        ({"settings": {"patch": 8, "mode": "crop"}}, "do not tell how its frames were fitted"),
        ({"settings": {"patch": 8, "fusion": "abc"}}, "a fitted rule of fusion; give the same file with --fusion"),
        ({"method": "monst3r"}, "is of monst3r; expected one that vggtjax made"),
    ],
)
def test_results_that_cannot_grow_are_refused(change, sentence, monkeypatch):
    class Model:
        name = "tiny"
        config = type("Config", (), {"patch_size": 8})

    settings = {"model_name": "tiny", "settings": {"patch": 8}} | change
    result = dataclasses.replace(exact(part_of_walk(slice(0, 4))), **settings)
    monkeypatch.setattr(extending, "check_kinds", lambda **_: None)
    with pytest.raises(InputError, match=sentence):
        extending.extend(Model(), result, np.asarray(walk().images[4:8]))  # pyright: ignore[reportArgumentType]


def test_the_options_are_those_of_the_result():
    result = dataclasses.replace(exact(part_of_walk(slice(0, 4))), method="4dvggt-d")
    for options in (Options(), Options(mask="matches", threshold="multi-otsu", smooth_frames=3, consistent_depth=True)):
        settings = options.to_json() | {"consistent_depth": options.consistent_depth}
        settings.pop("method")
        found = options_of(dataclasses.replace(result, settings=settings))
        assert found == options.changed(mask=options.row.mask, threshold=options.row.threshold)

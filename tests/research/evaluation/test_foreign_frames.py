"""Sources of results, and where other projects' frames lie in the pictures they came from."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest

from tests.shared.room import make_room
from tests.shared.tiny import tiny_model
from vggtjax import load_clip
from vggtjax.errors import InputError
from vggtjax.method.assembly import check_fuses
from vggtjax.method.fusion.family import paper_rule
from vggtjax.network.checkpoint import read_model, save_model
from vggtjax.progress import no_stage
from vggtjax.research.evaluation.datasets.sequence import LabelledSequence
from vggtjax.research.evaluation.foreign_frames import placed
from vggtjax.research.evaluation.sources import FolderSource, ModelSource


def of_size(width, height, frames=2):
    shape = (frames, height, width)
    return dataclasses.replace(
        make_room(frames, 14, 14),
        depth=np.ones(shape, np.float32),
        depth_confidence=np.ones(shape, np.float32),
        dynamic_mask=np.zeros(shape, bool),
        images=np.zeros((*shape, 3), np.uint8),
        saliency=None,
        valid_box=np.tile([0, 0, width, height], (frames, 1)),
    )


def test_our_own_know_by_themselves():
    room = make_room(2, frame_names=("a", "b"))  # from pictures of twice the size
    assert placed(room, "vggtjax", [(84, 56)] * 2, ["a", "b"]) is room
    frames = placed(room, "vggtjax", [(42, 28)] * 2, ["a", "b"])  # the frames themselves, as exports hold them
    assert frames.source_size.tolist() == [[28, 42]] * 2
    assert (frames.source_scale.tolist(), frames.source_offset.tolist()) == ([[1, 1]] * 2, [[0, 0]] * 2)
    with pytest.raises(InputError, match=r"frame 1 of the result was 84 x 56, the sequence's picture is \(80, 56\)"):
        placed(room, "vggtjax", [(84, 56), (80, 56)], ["a", "b"])
    with pytest.raises(InputError, match=r"the result is of frames a, b, \.\.\. and the sequence has c, d"):
        placed(room, "vggtjax", [(84, 56)] * 2, ["c", "d"])
    second = placed(room, "vggtjax", [(84, 56)] * 2, ["b", "c"])  # of which it has one
    np.testing.assert_array_equal(second.depth, room.depth[1:])
    with pytest.raises(InputError, match=r"the result is of frames a, b, \.\.\. and the sequence has b, c"):
        placed(room, "vggtjax", [(84, 56)] * 2, ["b", "c"], strict=True)


@pytest.mark.parametrize(("width", "height"), [(854, 480), (480, 854)])
def test_vggt4d_does_as_load_clip(width, height):
    clip = load_clip(np.zeros((2, height, width, 3), np.uint8), size=518)
    H, W = clip.images.shape[1:3]
    made = placed(of_size(W, H), "vggt4d", [(width, height)] * 2, ["a", "b"])
    np.testing.assert_array_equal(made.source_size, clip.source_size)
    np.testing.assert_allclose(made.source_scale, clip.source_scale)
    np.testing.assert_allclose(made.source_offset, clip.source_offset)


@pytest.mark.parametrize(
    ("layout", "picture", "frame", "scale", "offset"),
    [
        ("da3", (1920, 1080), (504, 280), (1920 / 504, 1080 / 280), (0, 0)),  # stretches
        ("monst3r", (1000, 600), (512, 304), 1000 / 512, (0, 1 * 600 / 307)),  # 307 rows, of which 304 about the middle
        ("monst3r", (1024, 1024), (512, 384), 2, (0, 2 * 64)),  # squares are cut to 4 : 3
        ("pomato", (1000, 600), (512, 304), 1000 / 512, (0, 1 * 600 / 307)),
        ("spatialtrackerv2", (854, 480), (336, 190), (854 / 336, 480 / 190), (0, 0)),  # 518 x 294, then shrunk
        ("spatialtrackerv2", (480, 854), (336, 336), (480 / 336, 854 / 924 * 518 / 336), (0, 203 * 854 / 924)),
    ],
)
def test_others_cut_about_the_middle_or_stretch(layout, picture, frame, scale, offset):
    made = placed(of_size(*frame), layout, [picture] * 2, ["a", "b"])
    np.testing.assert_allclose(made.source_scale[0], scale, rtol=2e-3)
    np.testing.assert_allclose(made.source_offset[0], offset, atol=1e-9)


@pytest.mark.parametrize("layout", ["vggt4d", "monst3r", "das3r", "cut3r", "da3", "spatialtrackerv2"])
def test_frames_of_the_pictures_own_size_are_those_and_others_are_refused(layout):
    made = placed(of_size(854, 480), layout, [(854, 480)] * 2, ["a", "b"])
    np.testing.assert_array_equal(made.source_scale, np.ones((2, 2)))
    assert not made.source_offset.any()
    with pytest.raises(InputError, match=rf"frames of 518 x 294 do not come from pictures of 480 x 854 as {layout}"):
        placed(of_size(518, 294), layout, [(480, 854)] * 2, ["a", "b"])
    with pytest.raises(InputError, match="the result has 2 frames, the sequence 3; expected equal numbers"):
        placed(of_size(512, 384), layout, [(640, 480)] * 3, ["a", "b", "c"])


def numbered(*numbers, times=None, lost=()):
    result = of_size(64, 48, len(numbers))
    depth = np.array(numbers, np.float32)[:, None, None] * np.ones((48, 64), np.float32) + 1
    names = tuple(f"{number:06d}" for number in numbers)
    return dataclasses.replace(result, depth=depth, frame_names=names, timestamps=times, settings={"lost": [*lost]})


def found(result, names, times=None, format="vggt4d"):
    made = placed(result, format, [(64, 48)] * len(names), names, times)
    return dict(zip(made.frame_names, (made.depth[:, 0, 0] - 1).tolist(), strict=True))


def test_frames_of_others_are_the_sequences_by_number_or_time_or_not_at_all():
    letters = list("abcdef")
    assert found(numbered(0, 2, 5), letters) == {"a": 0, "c": 2, "f": 5}  # counted from 0
    assert found(numbered(0, 1, 2), ["10", "11", "12"]) == {"10": 0, "11": 1, "12": 2}  # as many
    assert found(numbered(3, 9), ["x_3", "x_6", "x_9"]) == {"x_3": 3, "x_9": 9}  # by the names' numbers
    assert found(numbered(*range(9)), ["0", "3", "6"]) == {"0": 0, "3": 3, "6": 6}  # of which the protocol takes some
    with pytest.raises(InputError, match="the result has 3 frames, the sequence 6; expected equal numbers, or"):
        found(numbered(0, 1, 2), letters)  # counted on: of which frames, nothing tells
    times = np.array([5.0, 5.1, 5.2, 5.3])
    keyframes = numbered(0, 1, times=np.array([5.101, 5.299]))
    assert found(keyframes, letters[:4], times) == {"b": 0, "d": 1}
    named = [f"17000000{second:02d}.000000" for second in range(4)]
    assert found(numbered(0, 1, times=np.array([1700000001.0, 1700000003.0])), named) == {named[1]: 0, named[3]: 1}


@pytest.mark.parametrize("lost", [0, 2, 4])
def test_a_lost_frame_does_not_shift_the_others(lost):
    numbers = [number for number in range(5) if number != lost]
    names = [f"frame_{number:04d}" for number in range(1, 6)]  # as Sintel's, counted from 1
    assert found(numbered(*numbers, lost=[lost]), names) == {names[number]: number for number in numbers}
    later = [f"frame_{number:04d}" for number in range(2, 8)]  # by the names' numbers: one more than the result
    told = {f"frame_{number + 2:04d}": number + 2 for number in numbers}
    assert found(numbered(*(number + 2 for number in numbers), lost=[lost + 2]), later) == told


def test_as_many_frames_as_the_sequence_are_its_frames_in_order():
    names = [f"{number:05d}" for number in range(5)]
    assert found(numbered(1, 2, 3, 4, 5), names) == dict(zip(names, range(1, 6), strict=True))  # counted from 1
    assert found(numbered(10, 20, 30, 40, 50), names) == dict(zip(names, range(10, 60, 10), strict=True))
    assert found(numbered(1, 4), ["x_1", "x_6"]) == {"x_1": 1}  # not as many of the same
    many = [f"{number:05d}" for number in range(1500)]
    shown = numbered(*range(1500), times=np.arange(1500) / 30)  # 50 ms from the sequence's clock at the end
    assert found(shown, many, np.arange(1500) / 29.97) == dict(zip(many, range(1500), strict=True))


def test_our_own_are_found_by_time_where_no_name_fits():
    stated = np.array([1403636579.76, 1403636580.76, 1403636581.76])
    keyframes = numbered(0, 1, times=np.array([0.0, 1.0]))
    stating = dataclasses.replace(keyframes, settings={"first_time": 1403636580.755})
    stating = dataclasses.replace(stating, frame_names=("x", "y"), source_size=np.tile([48, 64], (2, 1)))
    assert found(stating, ["a", "b", "c"], stated, "vggtjax") == {"b": 0, "c": 1}
    counted = dataclasses.replace(stating, settings={})  # seconds from the first frame of some video
    with pytest.raises(InputError, match=r"the result is of frames x, y"):
        found(counted, ["a", "b", "c"], stated - stated[0], "vggtjax")


@pytest.fixture(scope="module")
def model():
    return tiny_model()


def retrained(model):
    params = jax.tree.map(lambda leaf: np.asarray(leaf) * np.float32(1.001), model.params)
    return dataclasses.replace(model, params=params)


def test_retrained_weights_are_another_model(tmp_path, model):
    read = read_model(save_model(tmp_path / "m.safetensors", model.params, model.config))
    read_again = read_model(save_model(tmp_path / "m.safetensors", retrained(model).params, model.config))
    for one, other in ((model, retrained(model)), (read, read_again), (read, retrained(read))):
        before, again = ModelSource(one, ["vggt"]).settings, ModelSource(one, ["vggt"]).settings
        assert before == again
        assert ModelSource(other, ["vggt"]).settings["model"]["sha256"] != before["model"]["sha256"]


def test_methods_that_do_not_fuse_run_beside_those_that_do(monkeypatch, model):
    fusion, calls = paper_rule(), []

    def methods(model, clip, names, *, fusion, **_):
        check_fuses(fusion, *names)  # as reconstruct_methods does
        calls.append((names, fusion))

    monkeypatch.setattr("vggtjax.pipeline.several.reconstruct_methods", methods)
    monkeypatch.setattr("vggtjax.clips.clip.read_clip", lambda *_: None)
    monkeypatch.setattr("vggtjax.clips.sources.open_source", lambda *_: None)
    source = ModelSource(model, ["vggt4d", "4dvggt-d"], fusion=fusion)
    sequence = LabelledSequence("s", (Path("0.png"),))
    for group in source.groups:
        source.results(group, sequence, no_stage)
    assert calls == [(["vggt4d"], None), (["4dvggt-d"], fusion)]
    with pytest.raises(InputError, match="'vggt4d' does not fuse"):
        ModelSource(model, ["vggt4d"], fusion=fusion)


@pytest.mark.parametrize("name", ["caf\udce9", "n" * 300, ""])
def test_names_of_results_are_short_and_printable(tmp_path, name):
    with pytest.raises(InputError, match="expected a short printable name") as error:
        FolderSource({name: tmp_path})
    assert str(error.value).isprintable()

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vggtjax.clips.media.sampling import Sampling
from vggtjax.errors import ClipError, InputError


def taken(times, **values):
    return [index for index, _, _ in Sampling(**values).select((time, None) for time in times)]


def test_indices():
    assert list(Sampling().indices(3)) == [0, 1, 2]
    assert list(Sampling(start=1, stride=3).indices(9)) == [1, 4, 7]
    assert list(Sampling(start=1, stride=3, max_frames=2).indices(9)) == [1, 4]
    assert list(Sampling(start=8, max_frames=5).indices(9)) == [8]


def test_each_tick_takes_the_first_frame_at_or_after_it():
    times = [0.0, 0.04, 0.1, 0.5, 0.52, 1.0, 1.3, 1.55]
    assert taken(times, fps=2) == [0, 3, 5, 7]
    assert taken(times, fps=2, max_frames=2) == [0, 3]
    assert taken(np.round(np.arange(30) / 30, 3), fps=15) == list(range(0, 30, 2))  # of rounded times, too
    numbers: Any = {"start": np.int64(1), "fps": np.float32(2)}
    assert Sampling(**numbers) == Sampling(1, fps=2)


@given(
    steps=st.lists(st.integers(1, 200), min_size=1, max_size=60),  # of 2 ms, so that none is 1 ms before a tick
    period=st.sampled_from([0.05, 0.25, 1.0]),
    start=st.integers(0, 5),
)
def test_rate_against_its_definition(steps, period, start):
    times = np.cumsum(steps) * 2 / 1000
    if start >= len(times):
        return
    ticks = times[start] + np.arange(0, times[-1] - times[start] + period, period)
    firsts = [next((i for i, time in enumerate(times) if time >= tick - 1e-3), None) for tick in ticks]
    assert taken(times, fps=1 / period, start=start) == sorted({i for i in firsts if i is not None})


def test_arguments_that_cannot_work():
    cases: Any = (
        ({"stride": 0}, "stride is 0; expected a whole number of at least 1"),
        ({"start": -1}, "start is -1; expected a whole number of at least 0"),
        ({"fps": float("nan")}, "fps is nan"),
        ({"fps": 2, "stride": 2}, "exclude each other"),
    )
    for values, message in cases:
        with pytest.raises(InputError, match=message):
            Sampling(**values)


def test_past_the_end():
    for select in (lambda: Sampling(start=5).indices(5), lambda: taken([0.0, 0.1, 0.2], start=5)):
        with pytest.raises(ClipError, match="start is 5, but the source has only"):
            select()
    with pytest.raises(ClipError, match="no frames"):
        taken([])
    with pytest.raises(InputError, match="still images have no presentation times"):
        Sampling(fps=2).indices(5)

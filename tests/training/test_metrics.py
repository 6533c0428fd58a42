import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from vggtjax.errors import InputError
from vggtjax.training.metrics import Averages, MetricsFile, plot, read_metrics


def row(step, **metrics):
    return {"step": step, "stage": 0, "seconds": step / 3, "samples": 2 * step, **metrics}


def test_averages():
    averages = Averages()
    averages.add({"loss": 1.0, "depth": 4.0})
    averages.add({"loss": math.nan, "skipped": 1.0}, finite_only=True)
    averages.add({"loss": 2.0})
    assert averages.take() == {"loss": 1.5, "depth": 4.0, "skipped": 1.0}
    averages.add({"loss": math.inf})
    assert averages.take() == {"loss": math.inf}


@given(st.lists(st.floats(allow_nan=False), min_size=1, max_size=5))
def test_numbers_come_back_exactly(tmp_path_factory, values):
    path = tmp_path_factory.mktemp("metrics") / "metrics.csv"
    rows = [row(step, loss=value) for step, value in enumerate(values)]
    table = MetricsFile(path, last_step=0)
    for one in rows:
        table.append(one)
    assert read_metrics(path) == rows


def test_new_metrics_widen_the_table(tmp_path):
    path = tmp_path / "metrics.csv"
    table = MetricsFile(path, last_step=0)
    table.append(row(1, loss=0.5))
    table.append(row(2, loss=0.25, match=1.0))
    table.append(row(3, match=0.5))
    assert path.read_text().splitlines() == [
        "step,stage,seconds,samples,loss,match",
        f"1,0,{1 / 3!r},2,0.5,",
        f"2,0,{2 / 3!r},4,0.25,1.0",
        "3,0,1.0,6,,0.5",
    ]


def test_rows_past_the_checkpoint_are_dropped(tmp_path):
    path = tmp_path / "metrics.csv"
    table = MetricsFile(path, last_step=0)
    for step in (2, 4, 6):
        table.append(row(step, loss=1.0))
    table = MetricsFile(path, last_step=4)
    assert [one["step"] for one in read_metrics(path)] == [2, 4]
    table.append(row(6, loss=3.0))
    assert [one["loss"] for one in read_metrics(path)] == [1.0, 1.0, 3.0]


def test_a_last_line_that_was_cut_short_is_left_out(tmp_path):
    path = tmp_path / "metrics.csv"
    table = MetricsFile(path, last_step=0)
    for step in (1, 2):
        table.append(row(step, loss=1.0))
    path.write_text(path.read_text()[:-7])
    assert [one["step"] for one in read_metrics(path)] == [1]


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "does not begin with the columns"),
        (b"\xff\xfe\n", "not a table of text"),
        (b"step,stage,seconds,samples\n1,2,x,4\n2,0,1,4\n", "line 2"),
    ],
)
def test_other_files_are_refused(tmp_path, content, says):
    path = tmp_path / "metrics.csv"
    path.write_bytes(content)
    with pytest.raises(InputError, match=says):
        read_metrics(path)
    with pytest.raises(InputError, match="cannot read"):
        read_metrics(tmp_path / "none.csv")


def test_curves(tmp_path):
    table = MetricsFile(tmp_path / "metrics.csv", last_step=0)
    plot(table.path, tmp_path / "empty.png")
    for step in range(1, 6):
        centre = math.nan if step == 2 else 1.0
        metrics = {"loss_depth": -0.1 * step, "rotation_error": 10 / step, "centre_error": centre, "grad_norm": 2.0}
        table.append(row(step, loss=1 / step, **metrics))
    plot(table.path, tmp_path / "metrics.png")
    empty, drawn = (np.asarray(Image.open(tmp_path / name).convert("RGB")) for name in ("empty.png", "metrics.png"))
    assert drawn.shape[0] > empty.shape[0]
    for colour in ((31, 119, 180), (255, 127, 14)):  # matplotlib's first two lines
        assert (drawn == np.array(colour)[None, None]).all(axis=-1).sum() > 50
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty.png", "metrics.csv", "metrics.png"]

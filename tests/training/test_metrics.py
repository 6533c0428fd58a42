import math

import pytest

from vggtjax.errors import InputError
from vggtjax.training.metrics import Averages, MetricsFile, read_metrics


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

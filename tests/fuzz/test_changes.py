"""Records of containers: cut and put together they are the bytes of the file, with their lengths."""

from functools import partial
from itertools import pairwise

import pytest

from tests.fuzz.changes.records import BOXES, RIFF, Layout
from tests.fuzz.rows.strangers import picture, video


def again(content: bytes, layout: Layout, start: int = 0) -> tuple[bytes, int]:
    """Return the content with every record put together anew, and how many there are."""
    pieces, places = [content[:start]], [start]
    while places[-1] < len(content) and (record := layout.cut(content, places[-1])) is not None:
        body, inner = record.body, layout.inner(record.head)
        if inner is not None:
            body, _ = again(body, inner[1], inner[0])
        pieces.append(layout.join(record.head, body))
        places.append(record.end)
    assert all(start < end for start, end in pairwise(places))
    return b"".join(pieces) + content[places[-1] :], len(places) - 1


@pytest.mark.parametrize(
    ("make", "layout", "least"),
    [
        (partial(picture, name="a.webp"), RIFF, 1),
        (partial(picture, name="a.jp2"), BOXES, 4),
        (partial(video, suffix=".mp4"), BOXES, 4),
        (partial(video, suffix=".avi"), RIFF, 1),
    ],
)
def test_records_are_put_together_as_they_were(make, layout, least, tmp_path):
    content = make(tmp_path).read_bytes()
    same, count = again(content, layout)
    assert same == content
    assert count >= least

"""Records of containers: cut and put together they are the bytes of the file, with lengths and checksums."""

from itertools import pairwise

import pytest

from tests.fuzz.changes import containers
from tests.fuzz.changes.records import Layout
from tests.fuzz.samples import picture_file, video_file


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
    ("make", "layout", "start", "least"),
    [
        (picture_file("a.webp"), containers.RIFF, 0, 1),
        (picture_file("a.jp2"), containers.BOXES, 0, 4),
        (video_file(".mp4", "mpeg4"), containers.BOXES, 0, 4),
        (video_file(".avi", "mpeg4"), containers.RIFF, 0, 1),
        (video_file(".mkv", "mpeg4"), containers.EBML, 0, 2),
        (video_file(".ts", "mpeg4"), containers.TRANSPORT, 0, 50),
        (video_file(".mpg", "mpeg1video"), containers.PROGRAM, 0, 5),
        (video_file(".wmv", "wmv2"), containers.ASF, 0, 3),
        (video_file(".flv", "flv"), containers.FLV, 13, 6),
        (video_file(".mxf", "mpeg2video"), containers.KLV, 0, 50),
        (video_file(".ogv", "libvpx"), containers.OGG, 0, 3),
    ],
)
def test_records_are_put_together_as_they_were(make, layout, start, least, tmp_path):
    content = make(tmp_path).read_bytes()
    same, count = again(content, layout, start)
    assert same == content
    assert count >= least

"""Lists of clips: names, paths, and a sentence with the line for what is wrong."""

import pytest

from vggtjax.clips.manifest import read_manifest
from vggtjax.clips.sources import clips_by_name
from vggtjax.errors import ClipError


def written(folder, name, text):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_both_kinds_name_the_same_clips(tmp_path):
    (tmp_path / "walk.v2").mkdir()
    table = written(tmp_path, "clips.csv", "name,source,split\nfirst,a/b.mp4,train\n,walk.v2,test\n,/there/yard.mp4,\n")
    lines = ['{"source": "a/b.mp4", "name": "first"}', "", '{"source": "walk.v2", "split": 3}']
    lines += ['{"source": "/there/yard.mp4"}', ""]
    expected = {"first": tmp_path / "a/b.mp4", "walk.v2": tmp_path / "walk.v2", "yard": tmp_path / "/there/yard.mp4"}
    assert read_manifest(table) == expected
    assert read_manifest(written(tmp_path, "clips.jsonl", "\n".join(lines))) == expected
    assert clips_by_name([str(table)]) == {name: str(path) for name, path in expected.items()}
    with pytest.raises(ClipError, match="two clips are named first"):
        clips_by_name([str(table), str(tmp_path / "clips.jsonl")])


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("a.csv", "path\nx.mp4\n", "has no column source"),
        ("a.csv", "source\n", "lists no clips"),
        ("a.csv", "source,name\nx.mp4,same\ny.mp4,same\n", "lines 2 and 3 both name a clip 'same'"),
        ("a.csv", "source,name\nx.mp4,../out\n", "line 2 names a clip '../out'; expected a plain name"),
        ("a.csv", "source,name\nx.mp4,.hidden\n", "expected a plain name"),
        ("a.csv", "source,name\n,x\n", "line 2 has the source ''; expected a path"),
        ("a.jsonl", '{"source": "x.mp4"}\n{"source": 3}\n', "line 2 has no source"),
        ("a.jsonl", '{"source": "x.mp4", "name": 3}\n', "line 1 has no source; expected source and, if wanted, name"),
        ("a.jsonl", '["x.mp4"]\n', "line 1 .*expected"),
        ("a.jsonl", "{\n", "line 1 is not JSON"),
        ("a.jsonl", '{"source": "x\\u0000.mp4"}\n', "line 1 has the source"),
    ],
)
def test_lists_that_are_none_are_one_sentence(tmp_path, name, text, sentence):
    with pytest.raises(ClipError, match=sentence):
        read_manifest(written(tmp_path, name, text))


def test_bytes_that_are_no_text(tmp_path):
    path = tmp_path / "a.csv"
    path.write_bytes(b"source\n\xff.mp4\n")
    with pytest.raises(ClipError, match="is no CSV file"):
        read_manifest(path)

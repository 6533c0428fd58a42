import pyarrow as pa
import pytest
from pyarrow import parquet

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
    paths = {"first": tmp_path / "a/b.mp4", "walk.v2": tmp_path / "walk.v2", "yard": tmp_path / "/there/yard.mp4"}
    expected = {name: str(path) for name, path in paths.items()}
    assert read_manifest(table) == expected
    assert read_manifest(written(tmp_path, "clips.jsonl", "\n".join(lines))) == expected
    columns = {"source": ["a/b.mp4", "walk.v2", "/there/yard.mp4"], "name": ["first", None, None], "split": [1, 2, 3]}
    parquet.write_table(pa.table(columns), tmp_path / "clips.parquet")
    assert read_manifest(tmp_path / "clips.parquet") == expected
    assert clips_by_name([str(table)]) == expected
    with pytest.raises(ClipError, match="two clips are named first"):
        clips_by_name([str(table), str(tmp_path / "clips.jsonl")])


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("a.csv", "source,name\nx.mp4,same\ny.mp4,same\n", "lines 2 and 3 both name a clip 'same'"),
        ("a.csv", "source,name\nx.mp4,../out\n", "line 2 names a clip '../out'; expected a plain name"),
        ("a.parquet", "PAR1 and nothing", "a.parquet is no parquet file: "),
    ],
)
def test_lists_that_are_none_are_one_sentence(tmp_path, name, text, sentence):
    written(tmp_path, name, text)
    with pytest.raises(ClipError, match=sentence):
        read_manifest(tmp_path / name)


def test_a_list_may_name_urls_and_one_from_a_url_names_nothing_of_this_machine(tmp_path):
    lines = "source,name\ns3://b/walks/yard.mp4,\nhttps://u:p@h/a%20b.mp4?key=secret,\nfile:///there/my%20cat.mp4,cat\n"
    named = {"yard": "s3://b/walks/yard.mp4", "a b": "https://u:p@h/a%20b.mp4?key=secret", "cat": "/there/my cat.mp4"}
    assert read_manifest(written(tmp_path, "a.csv", lines)) == named
    url = "s3://bucket/lists/a.csv"
    text, below = "source\nday/x.mp4\ngs://c/y.mp4\n", "s3://bucket/lists/day/x.mp4"
    assert read_manifest(written(tmp_path, "b.csv", text), url) == {"x": below, "y": "gs://c/y.mp4"}
    for source in ("/etc/passwd", "../up.mp4", "a/../../b.mp4", "file:///etc/passwd", "\\\\host\\share"):
        with pytest.raises(ClipError, match="a list from a URL names URLs, and paths below its own"):
            read_manifest(written(tmp_path, "c.csv", f"source\n{source}\n"), url)


def test_lists_that_would_fill_the_memory(tmp_path):
    column = pa.table({"source": ["x" * 40_000] * 500})
    parquet.write_table(column, tmp_path / "once.parquet", compression="zstd")  # in a dictionary, in 500 bytes
    parquet.write_table(column, tmp_path / "each.parquet", compression="zstd", use_dictionary=False)
    written(tmp_path, "a.jsonl", '{"source": "a", "x": [' + "0," * 40_000 + "0]}")
    for name, sentence in (
        ("once.parquet", "has a text of 40000 bytes"),
        ("each.parquet", "says that its text takes 200"),
        ("a.jsonl", "line 1 has more than 65536 bytes"),
    ):
        with pytest.raises(ClipError, match=sentence):
            read_manifest(tmp_path / name)

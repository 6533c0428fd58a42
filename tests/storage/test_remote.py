"""Files at URLs: copied whole, within bounds, inside the folder that was named; a sentence for everything else."""

from http.server import BaseHTTPRequestHandler

import pytest

from tests.shared.contents import contents
from tests.shared.servers import empty_memory, served
from vggtjax.errors import InputError, OutputError
from vggtjax.storage import remote
from vggtjax.storage.remote import check_url, download, exists, is_url, list_url, local_path, read_url, shown, upload


class Liar(BaseHTTPRequestHandler):
    """Names files outside the folder in its listing, and never stops sending others."""

    def do_GET(self):
        self.send_response(200)
        if self.path.rstrip("/") == "/walk":
            links = "1.png ../up.png /walk/2.png /etc/passwd http://127.0.0.1:1/3.png ..%2fup.png ?C=N"
            page = "".join(f'<a href="{link}">x</a>' for link in links.split()).encode()
            self.send_header("Content-Type", "text/html")
            self.send_header("Content-Length", str(len(page)))
            self.end_headers()
            self.wfile.write(page)
            return
        self.end_headers()
        try:
            for _ in range(1000 if "endless" in self.path else 1):
                self.wfile.write(b"x" * 2**16)
        except OSError:
            pass

    def log_message(self, format, *args):
        pass


@pytest.fixture
def memory():
    with empty_memory() as system:
        yield system


def test_folders_and_files_are_copied_whole_and_the_last_file_comes_last(memory, tmp_path, monkeypatch):
    files = {"a.bin": b"1", "end.npz": b"2" * 100_000, "z/b c#.txt": b"", "z/y/d.txt": b"4"}
    for name, content in files.items():
        (tmp_path / "out" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "out" / name).write_bytes(content)
    order, put = [], remote._put
    monkeypatch.setattr(remote, "_put", lambda *what: (order.append(what[2]), put(*what)))
    walk = "memory://results/walk"
    upload(tmp_path / "out", walk, last="end.npz")
    assert order[-1].endswith("/end.npz")
    assert len(order) == 4
    there = [exists(url) for url in (f"{walk}/end.npz", f"{walk}/z", "memory://results/other/end.npz")]
    assert there == [True, False, False]
    assert contents(download(walk, tmp_path)) == files
    assert download(f"{walk}/z/y/d.txt", tmp_path).read_bytes() == b"4"
    found = {entry.name: entry.is_folder for entry in list_url(walk)}
    assert found == {"a.bin": False, "end.npz": False, "z": True}
    assert read_url("memory://results/none", 9) is None
    with pytest.raises(InputError, match="has more than 9 bytes"):
        read_url(f"{walk}/end.npz", 9)


def test_a_file_system_without_whole_writes_gets_a_file_renamed(memory, tmp_path, monkeypatch):
    monkeypatch.setattr(remote, "SCHEMES", {"memory": "files"})
    (tmp_path / "a").write_bytes(b"1")
    moved = []
    move = type(memory).mv
    monkeypatch.setattr(type(memory), "mv", lambda self, *paths, **k: (moved.append(paths), move(self, *paths, **k)))
    upload(tmp_path, "memory://r/walk", last="a")
    assert [paths[0].endswith(".partial") and paths[1] for paths in moved] == ["/r/walk/a"]
    assert list(memory.find("/r")) == ["/r/walk/a"]
    monkeypatch.setattr(type(memory), "mv", lambda self, *paths: 1 / 0)
    with pytest.raises(OutputError, match=r"cannot reach memory://r/run \(division by zero\)"):
        upload(tmp_path, "memory://r/run", last="a")
    assert list(memory.find("/r")) == ["/r/walk/a"]


def test_a_web_server_is_read_and_what_it_names_stays_in_the_folder(tmp_path):
    (tmp_path / "site/my walk/deep").mkdir(parents=True)
    for name in ("1 b.png", "deep/2.png"):
        (tmp_path / "site/my walk" / name).write_bytes(name.encode())
    with served(tmp_path / "site") as url:
        assert contents(download(f"{url}/my%20walk/", tmp_path)) == {"1 b.png": b"1 b.png", "deep/2.png": b"deep/2.png"}
        assert (tmp_path / "my walk").is_dir()
        assert download(f"{url}/my%20walk/1%20b.png?key=1", tmp_path).name == "1 b.png"
        with pytest.raises(InputError, match=r"there is nothing at http://127.0.0.1:\d+/none.mp4; check the address"):
            download(f"{url}/none.mp4?key=secret", tmp_path)
    with served(Liar) as url:
        assert sorted(entry.name for entry in list_url(f"{url}/walk")) == ["1.png", "2.png"]
        assert sorted(contents(download(f"{url}/walk/", tmp_path))) == ["1.png", "2.png"]
        with pytest.raises(InputError, match="has more than 100000 bytes; expected at most so many"):
            download(f"{url}/endless.mp4", tmp_path, most_bytes=100_000)


def test_a_server_that_is_not_there_and_a_library_that_is_missing_are_one_sentence(monkeypatch, tmp_path):
    with pytest.raises(InputError, match=r"^cannot reach http://127.0.0.1:1/a.mp4 \(.*\); check the address, the net"):
        download("http://me:secret@127.0.0.1:1/a.mp4?key=secret", tmp_path)
    monkeypatch.setitem(__import__("sys").modules, "s3fs", None)
    with pytest.raises(InputError, match=r"^s3://bucket/a needs a package that is not installed: Install s3fs"):
        check_url("s3://bucket/a")


@pytest.mark.parametrize(
    "url", ["reference://a.json", "simplecache::s3://b/a", "s3://b/a::file:///etc/passwd", "s3://", "memory://a\nb"]
)
def test_other_urls_are_refused(url):
    with pytest.raises(InputError, match="is no URL that can be read; expected a path, or one of s3://, "):
        check_url(url)


def test_what_is_a_url():
    assert is_url("s3://b/a")
    assert not any(map(is_url, ("/a/b", "C:\\a", "a://"[:1], "file:///a", 3, None)))
    assert local_path("file:///a/b%20c") == "/a/b c"
    assert local_path("a%20b") == "a%20b"
    assert shown("https://me:secret@h/a/b?key=secret#x") == "https://h/a/b"
    assert shown("/a?b") == "/a?b"
    with pytest.raises(InputError, match="can be read, not written"):
        check_url("https://h/a", written=True)
    for name in ("https://h/..", "https://h/a%2fb", "https://h/a%00"):
        with pytest.raises(InputError, match="ends in no name of a file"):
            remote.url_name(name)

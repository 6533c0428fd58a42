"""The commands view and render: what they write, and one sentence for what they cannot do."""

import socket
import threading
import urllib.request

import av
import pytest
from PIL import Image

from tests.shared.command import refusal, run
from tests.shared.room import make_room
from vggtjax.errors import InputError
from vggtjax.interface.commands import view
from vggtjax.results.viewer.page import viewer_page
from vggtjax.results.viewer.server import PageServer


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("results") / "room"
    make_room(3).save(folder)
    return folder


def refused(capsys, *arguments) -> str:
    return refusal(capsys, "view", *arguments)


def test_a_page_is_written(tmp_path, capsys, folder):
    page = tmp_path / "scene.html"
    code, out, err = run(capsys, "view", folder, folder, "--export", page)
    assert code == 0, err
    assert str(page) in out
    assert page.read_text(encoding="utf-8").startswith("<!doctype html>")


def test_an_existing_page_is_replaced_on_request_and_the_result_never(tmp_path, capsys, folder):
    page = tmp_path / "mine.html"
    page.write_text("mine")
    assert "exists and is not replaced" in refused(capsys, folder, "--export", page)
    assert page.read_text() == "mine"
    assert run(capsys, "view", folder, "--export", page, "--overwrite")[0] == 0
    assert page.read_text().startswith("<!doctype html>")
    report = folder / "report.html"
    report.write_text("the result's")
    assert "is part of the result" in refused(capsys, folder, "--export", report, "--overwrite")
    assert report.read_text() == "the result's"
    own = folder / "preview" / "viewer.html"
    for _ in range(2):  # added to a result, as the demo does
        assert run(capsys, "view", folder, "--export", own, "--overwrite")[0] == 0
    assert run(capsys, "view", folder, "--export", own)[0] == 2


def test_what_cannot_be_viewed_is_one_sentence(tmp_path, capsys, folder):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        for arguments, sentence in (
            ((), "no result; name the folder"),
            ((folder, "--export", tmp_path / "scene.mp4"), "ends with .html"),
            ((folder, "--export", tmp_path / "scene.viser"), "--to rerun writes a recording"),
            ((folder, "--port", port), f"port {port} of 127.0.0.1 is in use"),
            ((folder, "--host", "203.0.113.7"), "no address of this machine"),
            ((folder, "--format", "monst3r"), "--quaternion wxyz"),
        ):
            assert sentence in refused(capsys, *arguments)
    assert not list(tmp_path.iterdir())


class Ended:
    """Stands for the server's loop: it ends at once, as by Ctrl-C."""

    def __init__(self, monkeypatch, ssh):
        self.page, self.opened = "", []
        monkeypatch.setattr(PageServer, "serve_forever", lambda server: self.end(server))
        monkeypatch.setattr("webbrowser.open", lambda url: self.opened.append(url))
        monkeypatch.setenv("DISPLAY", ":0")
        monkeypatch.delenv("SSH_CONNECTION", raising=False)
        if ssh:
            monkeypatch.setenv("SSH_CONNECTION", "198.51.100.2 50000 198.51.100.7 22")

    def end(self, server):
        self.page, self.port = server.shown.page.decode(), server.server_port
        raise KeyboardInterrupt


def test_over_ssh_the_tunnel_is_told_and_no_browser_opened(monkeypatch, capsys, folder):
    ended = Ended(monkeypatch, ssh=True)
    code, out, _ = run(capsys, "view", folder, "--port", 0)
    assert code == 0
    assert f"The viewer: http://127.0.0.1:{ended.port}/" in out
    assert f"ssh -L {ended.port}:127.0.0.1:{ended.port} 198.51.100.7\n" in out
    assert ended.opened == []
    assert ended.page.startswith("<!doctype html>")
    assert "The viewer has ended." in out


def test_a_notebook_shows_a_result():
    viewer = make_room(2).view(names=["<b>mine</b>"], height=300)
    cell = viewer._repr_html_()
    assert cell.startswith('<iframe srcdoc="&lt;!doctype html')
    assert "height: 300px" in cell
    assert "<b>" not in viewer.html
    with pytest.raises(InputError, match="2 names for 1 results"):
        viewer_page([make_room(2)], names=["one", "two"])


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("render") / "result"
    make_room(3).save(folder)
    return folder


def render(capsys, *arguments):
    return run(capsys, "render", *arguments, "--seconds", 0.5, "--fps", 8)


def test_a_film_beside_the_previews(result, capsys):
    code, out, _ = render(capsys, result, "--size", "96x54")
    film = result / "preview" / "turntable.mp4"
    assert code == 0
    assert str(film) in out
    with av.open(str(film)) as container:
        assert sum(1 for _ in container.decode(video=0)) == 4
    make_room(2).save(result)  # a film of the earlier result goes with it
    assert not film.exists()


def test_a_gif_elsewhere_along_the_camera(result, tmp_path, capsys):
    how = ("--size", "96x54", "--path", "camera", "--out", tmp_path / "a.gif")
    assert render(capsys, result / "reconstruction.npz", *how)[0] == 0
    with Image.open(tmp_path / "a.gif") as film:
        assert film.size == (96, 54)


def test_an_existing_film_is_replaced_on_request_and_the_result_never(result, tmp_path, capsys):
    film = tmp_path / "mine.webp"
    film.write_bytes(b"mine")
    assert render(capsys, result, "--size", "32x18", "--out", film)[0] == 2
    assert film.read_bytes() == b"mine"
    assert render(capsys, result, "--size", "32x18", "--out", film, "--overwrite")[0] == 0
    assert film.stat().st_size > 100
    part = next((result / "preview").glob("*.webp"), None) or result / "preview" / "own.webp"
    part.write_bytes(b"part")
    linked = tmp_path / "link.webp"
    linked.symlink_to(part)
    for out in (part, linked):
        code, _, err = render(capsys, result, "--out", out, "--overwrite")
        assert (code, "is part of the result in" in err, part.read_bytes()) == (2, True, b"part")
    for _ in range(2):  # the film at its usual place is one of this command
        assert render(capsys, result, "--size", "32x18")[0] == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{tmp}"], "there is no {tmp}/reconstruction.npz; give the folder of a saved result or its"),
        (["{result}", "--out", "{tmp}/a.avi"], "{tmp}/a.avi has no known ending of a film; expected one of .mp4"),
        (["{result}", "--out", "{tmp}/no/a.gif"], "there is no folder {tmp}/no for the film; make it, or choose"),
    ],
)
def test_a_film_of_bad_input_is_refused(result, tmp_path, capsys, arguments, message):
    places = {"tmp": tmp_path, "result": result}
    words = [argument.format(**places) for argument in arguments]
    assert message.format(**places) in refusal(capsys, "render", *words)
    assert list(tmp_path.iterdir()) == []


def test_a_page_that_is_served_is_loaded_anew_when_its_result_was_replaced(tmp_path, monkeypatch):
    make_room(2).save(tmp_path / "result")
    known = view._times([tmp_path / "result"])
    make_room(3).save(tmp_path / "result")
    monkeypatch.setattr(view.time, "sleep", lambda _: None)
    assert len(next(view._changed([tmp_path / "result"], known))[0].depth) == 3
    exported = viewer_page([make_room(2)])
    assert "connect-src" not in exported.split("<script")[0]
    with PageServer(exported, port=0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        tags = []
        for _ in range(2):
            request = urllib.request.Request(server.access.url, method="HEAD")
            with urllib.request.urlopen(request) as answer:
                assert answer.read() == b""
                tags.append(answer.headers["ETag"].strip('"'))
            with urllib.request.urlopen(server.access.url) as answer:
                page = answer.read().decode()
            assert f'<meta name="page" content="{tags[-1]}">' in page
            assert "connect-src 'self'" in page
            server.show(exported)
        server.shutdown()
    assert tags[0] != tags[1]

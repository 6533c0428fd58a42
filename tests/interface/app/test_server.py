"""The app as it is served, over HTTP: who is let in, what is answered, what is left."""

import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(find_spec("gradio") is None, reason="the app needs the extra app")

PASSWORD = "correct horse"
_PROGRAM = """
import sys
from pathlib import Path
from vggtjax.interface.commands.main import main
from vggtjax.pipeline.pretrained import embedded
embedded.MODEL = Path(sys.argv[1])
sys.exit(main(["app", *sys.argv[2:]]))
"""


@contextmanager
def running(model: Path, folder: Path, *options: str) -> Iterator[int]:
    """Yield the port of an app whose model "demo" is tiny; check that SIGTERM ends it, and that no file is left."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    log, temporary = folder / "log", folder / "temporary"
    temporary.mkdir()
    command = [sys.executable, "-c", _PROGRAM, str(model), "--port", str(port), "--max-frames", "2", *options]
    with log.open("w") as output:
        process = subprocess.Popen(command, stdout=output, stderr=output, env=os.environ | {"TMPDIR": str(temporary)})
    try:
        end = time.monotonic() + 180
        while "Open http" not in log.read_text():
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < end, log.read_text()
            time.sleep(0.1)
        yield port
        process.terminate()
        assert process.wait(60) == 0
    finally:
        process.kill()
    assert not any(temporary.iterdir())


@pytest.fixture(scope="module")
def client(tiny_demo_file, tmp_path_factory):
    """A client of an app on this machine alone."""
    httpx = pytest.importorskip("httpx")
    options, folder = ("--max-upload-mb", "1", "--max-waiting", "1"), tmp_path_factory.mktemp("app")
    with running(tiny_demo_file, folder, *options) as port, httpx.Client(base_url=f"http://127.0.0.1:{port}") as opened:
        opened.timeout = 120
        yield opened


def upload(client, name: str, content: bytes):
    return client.post("/gradio_api/upload", files={"files": (name, content)})


def run(client, path: str, *others: object) -> str:
    """Ask for a job as the page does; return all that the page is told."""
    file = {"path": path, "meta": {"_type": "gradio.FileData"}}
    data = [[file], *(others or ("demo", "vggt", 2, 0))]
    asked = {"data": data, "fn_index": 0, "session_hash": "x", "trigger_id": 1}
    assert client.post("/gradio_api/queue/join", json=asked).status_code == 200
    return client.get("/gradio_api/queue/data", params={"session_hash": "x"}).text


def join(client, session: str):
    """Ask for the demo clip."""
    asked = {"data": [None, None, "4dvggt-d", 2, None], "fn_index": 1, "session_hash": session, "trigger_id": 1}
    return client.post("/gradio_api/queue/join", json=asked)


def test_one_job_runs_and_one_waits_until_they_are_cancelled(client):
    first = join(client, "a").json()["event_id"]
    with client.stream("GET", "/gradio_api/queue/data", params={"session_hash": "a"}) as told:
        for line in told.iter_lines():
            if "load" in line:  # a stage
                break
        second = join(client, "b").json()["event_id"]
        refused = join(client, "c")
        assert refused.status_code == 503
        assert "Queue is full. Max size is 1" in refused.text
        for session, event in (("a", first), ("b", second)):
            cancelled = {"session_hash": session, "fn_index": 1, "event_id": event}
            assert client.post("/gradio_api/cancel", json=cancelled).status_code == 200
    assert "cannot read" in run(client, upload(client, "next.mp4", b"words").json()[0])  # its turn has come


def test_an_error_is_a_sentence_without_paths(client):
    path = upload(client, "holiday.mp4", b"words").json()[0]
    said = run(client, path)
    message = re.search(r'"error":"([^"]*)"', said)
    assert message is not None, said
    assert message[1].startswith("cannot read video holiday.mp4: ")
    assert "/" not in message[1]


@pytest.mark.parametrize(
    "values", [("/etc/passwd", "vggt", 2, 0), ("demo", "other", 2, 0), ("demo", "vggt", 3, 0), ("demo", "vggt", 2, 31)]
)
def test_values_that_the_page_does_not_offer_are_refused(client, values):
    said = run(client, upload(client, "a.mp4", b"words").json()[0], *values)
    assert '"success":false' in said
    assert "cannot read" not in said  # the video was not opened


def test_files_of_the_machine_are_not_read(client, tmp_path):
    assert "cannot read" in run(client, upload(client, "a.mp4", b"words").json()[0])
    (tmp_path / "a.mp4").write_bytes(b"private")
    for path in (
        str(tmp_path / "a.mp4"),
        "/etc/passwd",
        "/dev/zero",
        upload(client, "b.mp4", b"").json()[0] + "/../../x",
    ):
        said = run(client, path)
        assert '"success":false' in said, path
        assert "cannot read" not in said, path
        assert client.get(f"/gradio_api/file={path}").status_code in (403, 404), path


def test_large_uploads_and_pages_of_strangers_are_not_shown(client):
    assert upload(client, "a.png", bytes(1_000_001)).status_code == 413
    path = upload(client, "page.html", b"<script>alert(1)</script>").json()[0]
    assert client.get(f"/gradio_api/file={path}").headers["content-disposition"].startswith("attachment")


def test_there_are_no_documents_of_an_interface(client):
    assert client.get("/openapi.json").status_code == 404
    assert client.get("/gradio_api/info").json() == {"named_endpoints": {}, "unnamed_endpoints": {}}


def test_without_a_password_requests_name_this_machine(client):
    assert client.get("/").status_code == 200
    assert client.get("/", headers={"host": "localhost"}).status_code == 200
    for host in ("evil.example", "127.0.0.1.evil.example", "[", "192.168.0.7"):
        assert client.get("/", headers={"host": host}).status_code == 400


def test_pages_of_other_sites_send_nothing(client):
    file = {"files": ("a.png", b"")}
    for site, code in (("cross-site", 403), ("same-origin", 200), ("none", 200)):
        answer = client.post("/gradio_api/upload", files=file, headers={"sec-fetch-site": site})
        assert answer.status_code == code, site
    assert client.get("/", headers={"sec-fetch-site": "cross-site"}).status_code == 200  # as a link there asks


def test_other_machines_need_the_password(tiny_demo_file, tmp_path):
    httpx = pytest.importorskip("httpx")
    options = "--host", "0.0.0.0", "--password", PASSWORD
    with (
        running(tiny_demo_file, tmp_path, *options) as port,
        httpx.Client(base_url=f"http://127.0.0.1:{port}") as client,
    ):
        for path in ("/config", "/gradio_api/info", "/gradio_api/file=/etc/passwd"):
            assert client.get(path).status_code == 401
        assert upload(client, "a.png", b"").status_code == 401
        joined = client.post("/gradio_api/queue/join", json={"data": [], "fn_index": 0, "session_hash": "x"})
        assert joined.status_code == 401
        for user, password in (("vggtjax", "wrong"), ("admin", PASSWORD), ("vggtjax", "")):
            assert client.post("/login", data={"username": user, "password": password}).status_code >= 400
        assert client.post("/login", data={"username": "vggtjax", "password": PASSWORD}).status_code == 200
        assert upload(client, "a.png", b"").status_code == 200
        client.headers["sec-fetch-site"] = "cross-site"  # with the cookie
        assert upload(client, "a.png", b"").status_code == 403

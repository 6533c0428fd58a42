"""What a stranger may send to the app: names of own uploads and the page's values, by the page's routes."""

import asyncio
import gc
import re
import socket
from contextlib import suppress
from pathlib import Path

import pytest

from vggtjax.app.jobs import Desk, Job
from vggtjax.app.limits import Limits
from vggtjax.app.models import Models
from vggtjax.viewer.door import Door

pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),  # of pandas, which gradio uses
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),  # event loops that gradio leaves
]

JOIN, UPLOAD = "/gradio_api/queue/join", "/gradio_api/upload"
PAGE_ROUTES = {
    ("GET", "/"),
    ("GET", "/assets/{path:path}"),
    ("GET", "/static/{path:path}"),
    ("GET", "/favicon.ico"),
    ("GET", "/theme.css"),
    ("GET", "/gradio_api/heartbeat/{session_hash}"),
    ("GET", "/gradio_api/queue/data"),
    ("GET", "/gradio_api/upload_progress"),
    ("POST", UPLOAD),
    ("POST", JOIN),
    ("POST", "/gradio_api/run/{api_name}"),
}


class Server:
    """The whole app behind a client; jobs only note which files they were given."""

    def __init__(self, folder):
        self.sent: list[bytes] = []
        self.desk = Desk(folder / "app", Models(()), Limits(max_upload_mb=1), self._note)
        pytest.importorskip("gradio", reason="the app needs the extra app")  # which takes seconds to import
        pytest.importorskip("httpx", reason="the test client needs httpx")
        from starlette.testclient import TestClient

        from vggtjax.app.server import build_application

        self.app = build_application(self.desk, Door("127.0.0.1", 7860, None))
        self.client = TestClient(self.app, base_url="http://127.0.0.1:7860")

    def _note(self, job: Job, *_):
        paths = job.source if isinstance(job.source, tuple) else (job.source,)
        self.sent += [path.read_bytes() for path in paths if path is not None]

    def run(self, files, *others):
        """Ask for a job as the page does; return what the page is told."""
        data = [files, *(others or ("demo", "vggt", 2, 0))]
        asked = {"data": data, "fn_index": 0, "session_hash": "x", "trigger_id": 1}
        assert self.client.post(JOIN, json=asked).status_code == 200
        return self.client.get("/gradio_api/queue/data", params={"session_hash": "x"}).text

    def upload(self, name="a.png", content=b"own", field="files", route=UPLOAD):
        return self.client.post(route, files={field: (name, content)})

    def kept(self):
        return [path for path in self.desk.uploads.rglob("*") if path.is_file()]


def file_data(path, **more):
    return {"path": str(path), "meta": {"_type": "gradio.FileData"}} | more


def _loops():
    """Return the event loops that do not run; isinstance would ask objects of torch for attributes, which warn."""
    loops = [each for each in gc.get_objects() if issubclass(type(each), asyncio.AbstractEventLoop)]
    return {loop for loop in loops if not loop.is_running()}


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    before = _loops()
    with pytest.MonkeyPatch.context() as patch:
        for name in ("GRADIO_TEMP_DIR", "GRADIO_ANALYTICS_ENABLED", "HF_HUB_DISABLE_TELEMETRY"):
            patch.setenv(name, "")  # the app sets them; they are put back
        made = Server(tmp_path_factory.mktemp("strangers"))
        with made.client:
            yield made
        made.desk.close()
        for loop in _loops() - before:  # gradio leaves some; collected later, they would warn in other tests
            with suppress(ValueError):  # half closed
                loop.close()


def test_files_of_the_machine_are_not_read(server, tmp_path):
    own = Path(server.upload().json()[0])
    assert "job done" in server.run([file_data(own, url="http://127.0.0.1/a", orig_name="a.png", size=3)])
    assert server.sent[-1] == b"own"
    before, sent = server.kept(), list(server.sent)
    private = tmp_path / "0.png"
    private.write_bytes(b"private")
    for path in (private, "/etc/passwd", "/dev/zero", own.parent / "../../x.png", f"{own.parent}/..", "\0"):
        plain = {"path": str(path)}
        for entry in (file_data(path), plain, str(path), plain | {"is_stream": True}, file_data(path, is_stream=True)):
            assert "job done" not in server.run([entry]), entry
        assert "job done" not in server.run([file_data(own)], file_data(path), "vggt", 2, 0), path
    assert server.kept() == before
    assert server.sent == sent


def test_no_address_is_fetched(server, monkeypatch):
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: pytest.fail("a name was looked up"))
    path = server.upload().json()[0]
    for address in ("https://example.com/x.mp4", "http://127.0.0.1:7860/config", "//example.com/x.mp4"):
        assert "job done" not in server.run([file_data(address)])
        assert "job done" not in server.run([file_data(path)], "demo", file_data(address), 2, 0)
    assert "job done" in server.run([file_data(path, url="https://example.com/x.mp4")])


@pytest.mark.parametrize(
    "values", [("/etc/passwd", "vggt", 2, 0), ("demo", 7, 2, 0), ("demo", "vggt", "many", 0), ("demo", "vggt", 2, None)]
)
def test_values_that_the_page_does_not_offer_are_said(server, values, capfd):
    path = server.upload().json()[0]
    assert "Not started" in server.run([file_data(path)], *values)
    assert "Traceback" not in capfd.readouterr().err


def test_large_and_broken_requests_are_refused(server):
    assert server.client.post(JOIN, content=b"[" * 3_000_000).status_code == 413
    assert server.client.post(JOIN, content=b"[" * 100_000).status_code == 422


def _routes(app, prefix=""):
    for route in app.routes:
        path = prefix + getattr(route, "path", "")
        if getattr(route, "methods", None):
            yield from ((method, path) for method in route.methods if method != "HEAD")
        elif hasattr(route, "original_router"):
            yield from _routes(route.original_router, prefix)
        elif hasattr(route, "app") and hasattr(route.app, "routes"):
            yield from _routes(route.app, path.rstrip("/"))


def test_only_the_routes_of_the_page_answer(server):
    there = set(_routes(server.app._app))
    assert there >= PAGE_ROUTES
    for method, path in sorted(there - PAGE_ROUTES):
        asked = re.sub(r"\{[^}]*\}", "x", path)
        assert server.client.request(method, asked).status_code == 404, (method, path)
    for method, path in (("GET", "/gradio_api/file=/etc/passwd"), ("POST", "/gradio_api/run/own"), ("POST", "/upload")):
        assert server.client.request(method, path).status_code == 404

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

        self.app = build_application(self.desk, None, 7860)
        self.client = TestClient(self.app, base_url="http://127.0.0.1:7860")

    def _note(self, job: Job, *_):
        paths = job.source if isinstance(job.source, tuple) else (job.source,)
        self.sent += [path.read_bytes() for path in paths if path is not None]

    def join(self, files, *others, **changes):
        data = [files, *(others or ("demo", "vggt", 2, 0))]
        return self.client.post(
            JOIN, json={"data": data, "fn_index": 0, "session_hash": "x", "trigger_id": 1} | changes
        )

    def upload(self, name="a.png", content=b"own", field="files", route=UPLOAD):
        return self.client.post(route, files={field: (name, content)})

    def events(self):
        return self.client.get("/gradio_api/queue/data", params={"session_hash": "x"}).text

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


def test_files_of_the_machine_are_not_read(server, tmp_path, capfd):
    own = Path(server.upload().json()[0])
    assert server.join([file_data(own, url="http://127.0.0.1/a", orig_name="a.png", size=3)]).status_code == 200
    assert "job done" in server.events()
    assert server.sent[-1] == b"own"
    before, sent = server.kept(), list(server.sent)
    deep = tmp_path / ("a" * 64)
    deep.mkdir()
    for private in (tmp_path / "0.png", deep / "0.png"):
        private.write_bytes(b"private")
    for path in (tmp_path / "0.png", "/etc/passwd", "/dev/zero", own.parent / "../../x.png", f"{own.parent}/..", "\0"):
        assert server.join([file_data(path)]).status_code == 400, path
        assert server.join([], file_data(path), "vggt", 2, 0).status_code == 400, path
    assert server.join([str(tmp_path / "0.png")]).status_code == 400
    assert server.join([{"path": "/etc/passwd", "is_stream": True}]).status_code == 400
    assert server.join([file_data(deep / "0.png")]).status_code == 200  # stands for an upload that is not there
    assert "not here any more" in server.events()
    assert server.kept() == before
    assert server.sent == sent
    assert "Traceback" not in capfd.readouterr().err


def test_no_address_is_fetched(server, monkeypatch):
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: pytest.fail("a name was looked up"))
    path = server.upload().json()[0]
    for address in ("https://example.com/x.mp4", "http://127.0.0.1:7860/config", "//example.com/x.mp4"):
        assert server.join([file_data(address)]).status_code == 400
    assert server.join([file_data(path, url="https://example.com/x.mp4")]).status_code == 200
    server.events()


@pytest.mark.parametrize(
    "changes",
    [
        {"data": ["x"]},
        {"data": [[], "demo", "vggt", 2, {"deep": {}}]},
        {"fn_index": "0"},
        {"session_hash": "../x"},
    ],
)
def test_what_the_page_does_not_send_is_refused(server, changes):
    assert server.join([], **changes).status_code == 400


@pytest.mark.parametrize(
    "values", [("/etc/passwd", "vggt", 2, 0), ("demo", 7, 2, 0), ("demo", "vggt", "many", 0), ("demo", "vggt", 2, None)]
)
def test_values_that_the_page_does_not_offer_are_said(server, values, capfd):
    path = server.upload().json()[0]
    assert server.join([file_data(path)], *values).status_code == 200
    assert "Not started" in server.events()
    assert "Traceback" not in capfd.readouterr().err


def test_large_requests_are_refused(server):
    assert server.client.post(JOIN, content=b"[" * 3_000_000).status_code == 413
    assert server.client.post(JOIN, content=b"[" * 100_000).status_code == 400
    assert server.client.post(JOIN, content=b"\xff").status_code == 400


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

"""The app in a real browser: the demo clip runs to the end; viewer, films, sheet and zip are there."""

import io
import os
import socket
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import pytest

from tests import chromium
from vggtjax.commands.main import main
from vggtjax.errors import InputError
from vggtjax.viewer.door import listening

TOKEN = "0123456789abcdef"


@pytest.fixture
def served(tmp_path):
    """The address of the app, in a process of its own, that asks for a token; at the end it leaves no file."""
    pytest.importorskip("gradio", reason="the app needs the extra app")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    log = tmp_path / "log"
    (tmp_path / "temporary").mkdir()
    command = [sys.executable, "-m", "vggtjax", "app", "--port", str(port), "--token", TOKEN, "--max-frames", "4"]
    environment = os.environ | {"TMPDIR": str(tmp_path / "temporary")}
    with log.open("w") as output:
        process = subprocess.Popen(command, stdout=output, stderr=output, env=environment)
    try:
        end = time.monotonic() + 180
        while "Open http" not in log.read_text():
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < end, log.read_text()
            time.sleep(0.1)
        yield f"http://127.0.0.1:{port}/"
    finally:
        process.terminate()
        process.wait(30)
    assert "Traceback" not in log.read_text()
    assert not any((tmp_path / "temporary").iterdir())


@pytest.fixture
def browser():
    with chromium.browser(webgl=True) as opened:
        yield opened


@pytest.mark.proof
def test_the_demo_clip_in_a_browser(served, browser):
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    requests: list[str] = []
    page.on("request", lambda request: requests.append(request.url))
    assert page.goto(served).status == 403
    page.set_default_timeout(60_000)  # of a busy machine
    page.goto(f"{served}?token={TOKEN}")
    page.click("#start")
    page.wait_for_selector("text=No clip yet")
    page.click("#example")
    page.wait_for_selector("#cancel")
    page.wait_for_selector(".job.done", timeout=240_000)
    viewer = page.wait_for_selector("iframe.viewer").content_frame()
    viewer.wait_for_selector("canvas", timeout=60_000)
    for tab in ("Film", "Layers"):
        page.get_by_role("tab", name=tab).click()
        page.wait_for_function(f"document.querySelector('#{tab.lower()} video')?.videoWidth > 0")
    page.get_by_role("tab", name="Sheet").click()
    page.wait_for_function("document.querySelector('#sheet img')?.naturalWidth > 0")
    page.wait_for_selector("#downloads a >> text=Report")
    link = page.get_by_role("link", name="Download everything").get_attribute("href")
    with zipfile.ZipFile(io.BytesIO(page.request.get(served + link).body())) as archive:
        names = {Path(name).name for name in archive.namelist()}
    assert names >= {"reconstruction.npz", "report.html", "scene.glb", "film.mp4", "layers.mp4", "sheet.png"}
    page.set_viewport_size({"width": 390, "height": 844})
    assert page.evaluate("document.documentElement.scrollWidth") <= 390  # one column
    assert [url for url in requests if not url.startswith((served, "data:", "blob:"))] == []


def test_a_port_in_use_is_one_sentence(capsys):
    with listening("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        assert main(["app", "--port", str(port)]) == 2
    assert f"port {port} of 127.0.0.1 is in use; give another one with --port" in capsys.readouterr().err
    with pytest.raises(InputError, match="port is 70000; expected 0 to 65535"), listening("127.0.0.1", 70000):
        pass


def test_a_missing_extra_and_a_short_token_are_named(capsys, monkeypatch):
    assert main(["app", "--token", "a"]) == 2
    assert "expected letters and digits, at least 16" in capsys.readouterr().err
    monkeypatch.setattr("vggtjax.errors.find_spec", lambda name: None)
    assert main(["app"]) == 2
    assert "pip install -e '.[app]'" in capsys.readouterr().err

"""The app in a real browser: the demo clip runs to the end; viewer, films, sheet and zip are there."""

import io
import zipfile
from pathlib import Path

import pytest

from tests.interface.app.test_server import PASSWORD, running
from tests.shared import chromium
from vggtjax.pipeline.pretrained import embedded


@pytest.fixture
def browser():
    with chromium.browser(webgl=True) as opened:
        yield opened


@pytest.mark.proof
def test_the_demo_clip_in_a_browser(tmp_path, browser):
    pytest.importorskip("gradio", reason="the app needs the extra app")
    with running(embedded.MODEL, tmp_path, "--password", PASSWORD) as port:
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.set_default_timeout(60_000)  # of a busy machine
        requests: list[str] = []
        page.on("request", lambda request: requests.append(request.url))
        served = f"http://127.0.0.1:{port}/"
        page.goto(served)
        page.fill("input[type=password]", PASSWORD)
        page.locator("input").first.fill("vggtjax")
        page.get_by_role("button", name="Login").click()
        page.click("#start")
        page.wait_for_selector("text=no clip yet")
        page.click("#example")
        page.click("#cancel")
        page.wait_for_selector("#status >> text=Cancelled.")
        page.click("#example")
        page.wait_for_selector("#status >> text=2 frames of", timeout=240_000)
        viewer = page.wait_for_selector("#viewer iframe").content_frame()
        viewer.wait_for_selector("canvas")
        for tab in ("Film", "Layers"):
            page.get_by_role("tab", name=tab).click()
            page.wait_for_function(f"document.querySelector('#{tab.lower()} video')?.videoWidth > 0")
        page.get_by_role("tab", name="Sheet").click()
        page.wait_for_function("document.querySelector('#sheet img')?.naturalWidth > 0")
        page.get_by_role("tab", name="Files").click()
        link = page.locator("#downloads a[href*='.zip']").first.get_attribute("href")
        with zipfile.ZipFile(io.BytesIO(page.request.get(link).body())) as archive:
            names = {Path(name).name for name in archive.namelist()}
        assert names >= {"reconstruction.npz", "report.html", "scene.glb", "film.mp4", "layers.mp4", "sheet.png"}
        page.set_viewport_size({"width": 390, "height": 844})
        assert page.evaluate("document.documentElement.scrollWidth") <= 390  # one column
        assert [url for url in requests if not url.startswith((served, "data:", "blob:"))] == []
    assert "Traceback" not in (tmp_path / "log").read_text()

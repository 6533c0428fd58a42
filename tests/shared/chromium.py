"""The system's Chromium, to open pages in tests; tests that need it skip where there is none."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

_NAMES = ("chromium", "chromium-browser", "google-chrome")
_WEBGL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")  # by the CPU


def chromium() -> str:
    """Return the program's path, or skip the test."""
    path = next(filter(None, map(shutil.which, _NAMES)), None)
    if path is None:
        pytest.skip("there is no Chromium on this machine")
    return path


@contextmanager
def browser(*, webgl: bool = False) -> Iterator[Any]:
    """Yield a browser of playwright, or skip the test."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = chromium()
    with api.sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=path, args=["--no-sandbox", *(_WEBGL if webgl else ())])
        yield opened
        opened.close()


def look(opened: Any, file: Path, width: int, script: str) -> tuple[Any, list[str]]:
    """Open a file at this width; return what a script says of the page, and all that went wrong or was loaded."""
    page, events = opened.new_page(viewport={"width": width, "height": 800}), []
    page.on("console", lambda message: events.append(message.text))
    page.on("pageerror", lambda error: events.append(str(error)))
    page.on("dialog", lambda dialog: (events.append(f"dialog {dialog.message}"), dialog.dismiss()))
    page.on("request", lambda request: events.append(request.url) if not request.url.startswith("data:") else None)
    page.goto(file.as_uri())
    answer = page.evaluate(script)
    page.close()
    return answer, [event for event in events if event != file.as_uri()]

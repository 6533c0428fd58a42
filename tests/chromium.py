"""The system's Chromium, to open pages in tests; tests that need it skip where there is none."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest


@contextmanager
def browser() -> Iterator[Any]:
    """Yield a browser of playwright, or skip the test."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if (path := shutil.which("chromium") or shutil.which("google-chrome")) is None:
        pytest.skip("there is no Chromium on this machine")
    with api.sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
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

"""The guard around the app: a token where it is exposed, no other sites, nothing but the page and its results."""

import asyncio
from typing import Any

import pytest

pytest.importorskip("starlette", reason="the app needs the extra app")

from vggtjax.app.access import Guard
from vggtjax.viewer.door import Door


async def answer(guard: Guard, scope: dict[str, Any], headers: dict[str, str]) -> tuple[int, dict[str, str]]:
    messages: list[dict[str, Any]] = []

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": b""}

    async def send(message: Any) -> None:
        messages.append(message)

    given = [(name.replace("_", "-").encode(), value.encode()) for name, value in headers.items()]
    await guard({"type": "http", "headers": given} | scope, receive, send)
    return messages[0]["status"], {name.decode(): value.decode() for name, value in messages[0]["headers"]}


def ask(
    guard: Guard, path: str = "/", *, method: str = "GET", query: str = "", **headers: str
) -> tuple[int, dict[str, str]]:
    """Return status and headers of a request."""
    scope = {"method": method, "path": path, "query_string": query.encode()}
    return asyncio.run(answer(guard, scope, {"host": "127.0.0.1:7860"} | headers))


async def app(scope: Any, receive: Any, send: Any) -> None:
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"page"})


@pytest.fixture
def guard(tmp_path):
    return lambda token=None: Guard(app, Door("127.0.0.1", 7860, token), 1_000_000, tmp_path)


def test_without_a_token_only_this_machine_is_answered(guard):
    for host in ("127.0.0.1:7860", "localhost:7860", "[::1]:7860", "localhost"):
        assert ask(guard(), host=host)[0] == 200
    for host in ("evil.example", "127.0.0.1.evil.example:7860", "[", ""):
        assert ask(guard(), host=host)[0] == 403


def test_the_token_opens_the_app_once_and_a_cookie_does_from_then(guard):
    exposed = guard("secret")
    status, headers = ask(exposed, query="token=secret", host="box:7860")
    assert status == 303
    assert "token" not in headers["location"]
    assert "HttpOnly" in headers["set-cookie"]
    assert ask(exposed, cookie=headers["set-cookie"].split(";")[0], host="box:7860")[0] == 200
    assert ask(exposed, host="box:7860")[0] == 403
    assert ask(exposed, query="token=wrong")[0] == 403
    for cookie in ("vggtjax_7860=wrong", "vggtjax_7860=é; =;"):
        assert ask(exposed, "/results/a/b.zip", cookie=cookie)[0] == 403


def test_uploads_are_bounded_before_they_are_read(guard):
    path = "/gradio_api/upload"
    assert ask(guard(), path, method="POST", content_length="900000")[0] == 200
    assert ask(guard(), path, method="POST", content_length="9000000")[0] == 413
    assert ask(guard(), "/gradio_api/queue/join", method="POST", content_length="1900000")[0] == 413
    assert ask(guard(), path, method="POST")[0] == 411
    assert ask(guard(), path, method="POST", content_length="9", sec_fetch_site="cross-site")[0] == 403


def test_browsers_are_told_to_load_nothing_from_elsewhere(guard):
    page, result = ask(guard())[1], ask(guard(), "/results/job/viewer.html")[1]
    assert page["content-security-policy"].startswith("default-src 'self'")
    assert "http" not in page["content-security-policy"]
    assert "sandbox allow-scripts" in result["content-security-policy"]

import http.client
import threading
from contextlib import contextmanager

import pytest

from vggtjax.results.viewer.server import PageServer

UPGRADE = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13", "Sec-WebSocket-Key": "eA=="}


@contextmanager
def served(**options):
    with PageServer("<p>the page</p>", port=0, **options) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


def get(server, path, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    body = answer.read().decode()
    connection.close()
    return answer.status, body, answer.headers


def test_on_this_machine_the_page_needs_no_token_and_nothing_else_is_served():
    with served() as server:
        assert get(server, "/")[:2] == (200, "<p>the page</p>")
        for path in ("/reconstruction.npz", "/../../etc/passwd", "/%2e%2e/etc/passwd", "//etc/passwd", "/index.html"):
            assert get(server, path)[0] == 404
        for host in ("evil.example:80", "["):  # a site that points its name at this machine; no name at all
            status, body, _ = get(server, "/", Host=host)
            assert status == 403
            assert "the page" not in body


@pytest.mark.parametrize("name", ["hub.example.org", "box:8888", "192.168.1.7:8080", "<script>"])
def test_a_page_asked_for_by_another_name_says_its_address(name):
    """Behind a proxy, as of Jupyter, there is no token that could be brought: none was printed."""
    with served() as server:
        body = get(server, "/", Host=name)[1]
        for words in (f"answers to this machine alone, as {server.access.url},", f"asked as {name}.", "--host 0.0.0.0"):
            assert words in body
    with served(host="0.0.0.0") as server:
        assert "with ?token= at its end; under another name keep that end" in get(server, "/", Host=name)[1]
        entered = get(server, f"/?token={server.access.token}", Host=name)
        assert (entered[0], entered[2]["Location"]) == (303, ".")  # under a proxy's folder, too


def test_elsewhere_every_request_needs_the_token():
    with served(host="0.0.0.0") as server:
        assert server.access.token
        assert server.access.url.endswith(f"/?token={server.access.token}")
        cookie = f"vggtjax_{server.server_port}"
        wrong = {"Cookie": f"{cookie}=wrong"}
        for path, headers in (("/", {}), ("/?token=%C3%A9", {}), ("/", wrong), ("/", UPGRADE), ("/any", {})):
            status, body, _ = get(server, path, **headers)
            assert status == 403
            assert "the page" not in body
        status, _, headers = get(server, f"/?token={server.access.token}")
        assert (status, headers["Location"]) == (303, ".")
        assert "HttpOnly" in headers["Set-Cookie"]
        assert get(server, "/", Cookie=headers["Set-Cookie"].split(";")[0])[:2] == (200, "<p>the page</p>")
        assert get(server, "/any", Cookie=headers["Set-Cookie"].split(";")[0])[0] == 404

"""Weights by hub id, from a server on this machine that answers as the hub does."""

import hashlib
import json
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import huggingface_hub
import huggingface_hub.constants
import jax
import numpy as np
import pytest

from benchmarks.make_checkpoint import make_checkpoint
from benchmarks.seeded import seeded_state_dict
from converters import convert, convert_state_dict
from converters.locate import locate
from vggtjax import load_model
from vggtjax.errors import CheckpointError, MissingExtraError

COMMIT = "0123456789abcdef0123456789abcdef01234567"
INDEX = "model.safetensors.index.json"


class Hub(ThreadingHTTPServer):
    """Repositories by id, each a folder, or an error code such as GatedRepo; remembers what was asked."""

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Answer)
        self.repositories = {}
        self.asked = []


class Answer(BaseHTTPRequestHandler):
    def do_GET(self):
        assert isinstance(self.server, Hub)
        self.server.asked.append((self.command, self.path))
        owner_and_name = "/".join(self.path.removeprefix("/api/models/").strip("/").split("/")[:2])
        repository = self.server.repositories.get(owner_and_name, "RepoNotFound")
        if isinstance(repository, str):
            self.answer({"GatedRepo": 403, "Down": 500}.get(repository, 401), b"", {"X-Error-Code": repository})
        elif self.path.startswith("/api/models/"):
            files = [{"rfilename": path.name} for path in sorted(repository.iterdir())]
            content = {"id": owner_and_name, "sha": COMMIT, "siblings": files}
            self.answer(200, json.dumps(content).encode(), {"Content-Type": "application/json"})
        else:
            content = (repository / self.path.rsplit("/", 1)[1]).read_bytes()
            digest = hashlib.sha256(content).hexdigest()
            self.answer(200, content, {"ETag": f'"{digest}"', "X-Repo-Commit": COMMIT})

    do_HEAD = do_GET  # noqa: N815

    def answer(self, status, content, headers):
        self.send_response(status)
        for name, value in {"Content-Length": str(len(content)), **headers}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(content)

    def log_message(self, format, *args):
        """Say nothing."""


@pytest.fixture
def hub(tmp_path, monkeypatch):
    server = Hub()
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    endpoint = f"http://127.0.0.1:{server.server_port}"  # as HF_ENDPOINT, which was read on import
    monkeypatch.setattr(huggingface_hub.constants, "ENDPOINT", endpoint)
    template = endpoint + "/{repo_id}/resolve/{revision}/{filename}"
    monkeypatch.setattr(huggingface_hub.constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setenv("VGGTJAX_CACHE", str(tmp_path / "cache"))
    yield server
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.fixture(scope="module")
def shapes(golden):
    return json.loads((golden / "shapes.json").read_text())


@pytest.fixture(scope="module")
def expected(shapes, config):
    return convert_state_dict(seeded_state_dict(shapes), config)


@pytest.fixture
def repository(hub, tmp_path):
    folder = tmp_path / "repository"
    folder.mkdir()
    hub.repositories["maker/tiny"] = folder
    (folder / "README.md").write_text("a model")
    return folder


def assert_equal(model, expected):
    assert jax.tree.all(jax.tree.map(np.array_equal, model.params, expected))


def refusal(source) -> str:
    with pytest.raises(CheckpointError) as raised:
        locate(source)
    assert "\n" not in str(raised.value)
    return str(raised.value)


def test_single_file_is_downloaded_and_converted_once(hub, repository, shapes, expected, config):
    make_checkpoint(repository / "model.safetensors", shapes)
    (repository / "model.pt").write_bytes(b"not asked for")
    model = load_model("maker/tiny", config=config)
    assert_equal(model, expected)
    assert model.name == "maker/tiny"
    assert model.path is not None
    assert model.path.name.startswith("maker-tiny-")
    again = load_model("maker/tiny", config=config)
    assert again.path == model.path
    downloads = [path for method, path in hub.asked if method == "GET" and "/resolve/" in path]
    assert downloads == ["/maker/tiny/resolve/main/model.safetensors"]


def test_shards(hub, repository, shapes, expected, config, tmp_path):
    make_checkpoint(repository, shapes, shards=2)
    assert_equal(load_model(convert("maker/tiny", tmp_path / "out.safetensors", config=config).path), expected)


def test_torch_file_where_there_is_nothing_better(hub, repository, shapes, expected, config):
    make_checkpoint(repository / "weights.pt", shapes, format="pt")
    assert_equal(load_model("maker/tiny", config=config), expected)


def test_without_network_the_cache_serves(hub, repository, monkeypatch):
    make_checkpoint(repository, {"a": [2], "b": [2]}, shards=2)
    path = locate("maker/tiny").path
    hub.repositories["maker/tiny"] = "Down"
    assert locate("maker/tiny").path == path
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    assert locate("maker/tiny").path == path
    next(path.parent.glob("*-00002-of-*")).unlink()
    assert "cannot be downloaded" in refusal("maker/tiny")


def test_out_of_reach(hub, monkeypatch):
    monkeypatch.setattr(huggingface_hub.constants, "ENDPOINT", "http://127.0.0.1:9")  # nobody listens there
    message = refusal("maker/tiny")
    assert "'maker/tiny' is not in the hub's cache and cannot be downloaded" in message
    assert "check the network" in message
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    assert "cannot be downloaded" in refusal("maker/tiny")


def test_missing_and_gated(hub, repository):
    assert "'maker/none' is neither an existing path nor a visible repository" in refusal("maker/none")
    hub.repositories["maker/gated"] = "GatedRepo"
    assert "'maker/gated' is gated; request access" in refusal("maker/gated")
    assert "the hub's 'maker/tiny' holds no weights" in refusal("maker/tiny")


def test_files_of_the_repository_are_not_trusted(hub, repository):
    (repository / INDEX).write_text(json.dumps({"weight_map": {"a": "../../secret.safetensors"}}))
    assert "expected names of files in its folder" in refusal("maker/tiny")


def test_hub_is_an_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'vggtjax\[hub\]'"):
        locate("maker/tiny")


def test_one_of_several_files(hub, repository, shapes, expected, config):
    for name in ("a_e20.pt", "a_e30.pt"):
        make_checkpoint(repository / name, shapes, format="pt")
    assert "holds 2 files of weights (a_e20.pt, a_e30.pt)" in refusal("maker/tiny")
    model = load_model("maker/tiny/a_e20.pt", config=config)
    assert_equal(model, expected)
    assert model.name == "maker/tiny/a_e20.pt"
    assert "has no file a_e10.pt; its files of weights are a_e20.pt, a_e30.pt" in refusal("maker/tiny/a_e10.pt")
    hub.repositories["maker/tiny"] = "Down"
    assert locate("maker/tiny/a_e20.pt").path.name == "a_e20.pt"
    message = refusal("maker/tiny/a_e30.pt")
    assert "the hub is unreachable, and its cache of 'maker/tiny' holds no a_e30.pt, only a_e20.pt" in message


def test_a_mistyped_path_stays_here(hub, tmp_path, monkeypatch):
    (tmp_path / "runs/vggt").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    assert "there are no weights at runs/vggt/modl.pt" in refusal("runs/vggt/modl.pt")
    assert "there are no weights at runs/vgt" in refusal("runs/vgt")
    assert not hub.asked

import hashlib
import json
import re
import shutil
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import huggingface_hub
import huggingface_hub.constants
import jax
import numpy as np
import pytest

from converters import convert_state_dict
from converters.locate import locate
from tests.shared.make_checkpoint import make_checkpoint
from tests.shared.seeded import seeded_state_dict
from vggtjax import load_model
from vggtjax.errors import CheckpointError

COMMIT = "0123456789abcdef0123456789abcdef01234567"
LATER = "89abcdef0123456789abcdef0123456789abcdef"
INDEX = "model.safetensors.index.json"


class Hub(ThreadingHTTPServer):
    """Repositories by id, each a folder, or "Down"; remembers what was asked.

    Every commit has the files of the folder. The bytes of the `tampered` names are not those that it declares.
    """

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Answer)
        self.repositories = {}
        self.asked = []
        self.commit = COMMIT  # of the default branch
        self.tampered = set()


def declared(path):
    """Return what the hub's API says of a file: sha256 for one in large storage, git's id for one in git."""
    content = path.read_bytes()
    git_id = hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()
    facts = {"rfilename": path.name, "size": len(content), "blobId": git_id}
    if path.suffix in (".safetensors", ".pt"):
        facts["lfs"] = {"sha256": hashlib.sha256(content).hexdigest(), "size": len(content), "pointerSize": 134}
    return facts


class Answer(BaseHTTPRequestHandler):
    def do_GET(self):
        assert isinstance(self.server, Hub)
        self.server.asked.append((self.command, self.path))
        path, _, query = self.path.partition("?")
        parts = path.removeprefix("/api/models/").strip("/").split("/")  # owner, name, revision, COMMIT
        repository = self.server.repositories["/".join(parts[:2])]
        commit = parts[3] if len(parts) > 3 else self.server.commit
        if isinstance(repository, str):
            self.answer(500, b"", {})
        elif commit not in (COMMIT, LATER, "main"):
            self.answer(404, b"", {"X-Error-Code": "RevisionNotFound"})
        elif path.startswith("/api/models/"):
            files = [declared(path) for path in sorted(repository.iterdir())]
            files = files if query == "blobs=true" else [{"rfilename": file["rfilename"]} for file in files]
            content = {"id": "/".join(parts[:2]), "sha": commit, "siblings": files}
            self.answer(200, json.dumps(content).encode(), {"Content-Type": "application/json"})
        else:
            facts = declared(repository / parts[-1])
            content = (repository / parts[-1]).read_bytes()
            if parts[-1] in self.server.tampered:
                content = content[:-1] + bytes([content[-1] ^ 1])
            etag = facts["lfs"]["sha256"] if "lfs" in facts else facts["blobId"]
            served = self.server.commit if commit == "main" else commit
            self.answer(200, content, {"ETag": f'"{etag}"', "X-Repo-Commit": served})

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


@pytest.fixture
def repository(hub, tmp_path):
    folder = tmp_path / "repository"
    folder.mkdir()
    hub.repositories["maker/tiny"] = folder
    (folder / "README.md").write_text("a model")
    return folder


def refusal(source) -> str:
    with pytest.raises(CheckpointError) as raised:
        locate(source)
    return str(raised.value)


def test_single_file_is_downloaded_and_converted_once(hub, repository, shapes, config):
    make_checkpoint(repository / "model.safetensors", shapes)
    (repository / "model.pt").write_bytes(b"not asked for")
    model = load_model("maker/tiny", config=config)
    expected = convert_state_dict(seeded_state_dict(shapes), config)
    assert jax.tree.all(jax.tree.map(np.array_equal, model.params, expected))
    assert (model.name, model.revision, model.summary()["revision"]) == ("maker/tiny", COMMIT, COMMIT)
    again = load_model("maker/tiny", config=config)
    assert again.path == model.path
    downloads = [path for method, path in hub.asked if method == "GET" and "/resolve/" in path]
    assert downloads == [f"/maker/tiny/resolve/{COMMIT}/model.safetensors"]


def test_without_network_the_cache_serves(hub, repository, monkeypatch):
    make_checkpoint(repository, {"a": [2], "b": [2]}, shards=2)
    path = locate("maker/tiny").path
    hub.repositories["maker/tiny"] = "Down"
    assert locate("maker/tiny").path == path
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    assert locate("maker/tiny").path == path
    next(path.parent.glob("*-00002-of-*")).unlink()
    assert "cannot be downloaded" in refusal("maker/tiny")


def test_a_branch_is_resolved_once_and_a_given_commit_is_used(hub, repository):
    (repository / "model.safetensors").write_bytes(b"weights")
    assert locate("maker/tiny").revision == COMMIT
    hub.commit = LATER
    (repository / "model.safetensors").write_bytes(b"weights of later")
    asked = len(hub.asked)
    assert locate("maker/tiny").path.read_bytes() == b"weights"
    assert len(hub.asked) == asked  # the record and the cache know all
    later = locate(f"maker/tiny/model.safetensors@{LATER}")
    assert later.path.read_bytes() == b"weights of later"
    assert later.revision == LATER
    assert locate("maker/tiny").revision == COMMIT
    assert "revision 'main' of 'maker/tiny' is not a commit; expected its 40 hex" in refusal("maker/tiny@main")
    assert f"'maker/tiny' has no commit {'0' * 40}" in refusal(f"maker/tiny@{'0' * 40}")


@pytest.mark.parametrize("name", [INDEX, "model-00002-of-00002.safetensors"])
def test_a_file_that_is_not_what_the_hub_declares_is_refused(hub, repository, name):
    make_checkpoint(repository, {"a": [2], "b": [2]}, shards=2)
    hub.tampered.add(name)
    message = refusal("maker/tiny")
    assert f"{name} of the hub's 'maker/tiny' has the digest" in message
    assert "delete" in message
    hub.tampered.clear()
    Path(re.findall("delete (.*) and download", message)[0]).unlink()  # as it says
    assert locate("maker/tiny").path.name == INDEX


def test_a_later_download_with_another_digest_is_refused(hub, repository, tmp_path):
    (repository / "model.safetensors").write_bytes(b"weights")
    locate("maker/tiny")
    shutil.rmtree(tmp_path / "hub")
    (repository / "model.safetensors").write_bytes(b"weights that the maker replaced")  # and declares anew
    recorded = hashlib.sha256(b"weights").hexdigest()
    for _ in range(2):
        assert f"not the recorded {recorded[:16]}...; do not use it" in refusal("maker/tiny")
    record = tmp_path / "cache/hub/maker/tiny.json"
    assert json.loads(record.read_text())["files"][COMMIT]["model.safetensors"]["digest"] == recorded
    record.write_text("{")
    assert f"{record} is not JSON that can be read" in refusal("maker/tiny")


def test_files_of_the_repository_are_not_trusted(hub, repository):
    (repository / INDEX).write_text(json.dumps({"weight_map": {"a": "../../secret.safetensors"}}))
    assert "expected names of files in its folder" in refusal("maker/tiny")


def test_a_mistyped_path_stays_here(hub, tmp_path, monkeypatch):
    (tmp_path / "runs/vggt").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    assert "there are no weights at runs/vggt/modl.pt" in refusal("runs/vggt/modl.pt")
    assert "there are no weights at runs/vgt" in refusal("runs/vgt")
    assert not hub.asked

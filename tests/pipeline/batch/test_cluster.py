"""Clips on a cluster of Ray: each good one once, whatever becomes of a worker; a sentence for what is no cluster."""

import json
import os
import signal
import subprocess
import sys
from functools import partial
from types import SimpleNamespace
from weakref import WeakSet

import numpy as np
import pytest
from PIL import Image

from tests.shared.moving_ball import moving_ball
from tests.shared.room import make_room
from tests.shared.tiny import tiny_model
from vggtjax.clips.fingerprint import source_setting
from vggtjax.clips.sources import open_source
from vggtjax.errors import ClusterError, InputError, MissingExtraError
from vggtjax.network.checkpoint import save_model
from vggtjax.options import Options
from vggtjax.pipeline.batch.cluster import Cluster, reconstruct_on_cluster, shared
from vggtjax.pipeline.batch.destination import SETTINGS_NAME, LocalFolder
from vggtjax.pipeline.batch.recipe import CHANGED, BatchRecipe, ClipOutcome
from vggtjax.pipeline.batch.worker import Worker
from vggtjax.results.archive import ARCHIVE_NAME
from vggtjax.storage.versions import running_versions

pytest.importorskip("ray", reason="Ray is not installed: pip install -e '.[cluster]'")
RECIPE = BatchRecipe(options=Options(method="vggt"))


@pytest.mark.proof
def test_a_killed_worker_costs_its_clips_alone_and_they_are_run_again(tmp_path):
    """Eight clips, one of them corrupt, on two workers, of which one is killed once two clips are there."""
    frames = (255 * moving_ball(2)).astype(np.uint8)
    for number in range(8):
        (tmp_path / f"clips/{number}").mkdir(parents=True)
        for i, frame in enumerate(frames):
            Image.fromarray(np.roll(frame[:70], number, axis=1)).save(tmp_path / f"clips/{number}/{i}.png")
    (tmp_path / "clips/2/1.png").write_bytes(b"broken")
    model = tiny_model()
    save_model(tmp_path / "tiny.safetensors", model.params, model.config)
    command = [sys.executable, "-m", "vggtjax", "batch", str(tmp_path / "clips"), "--method", "vggt", "--only", ""]
    command += ["--no-consistent-depth"]
    command += ["--model", str(tmp_path / "tiny.safetensors"), "--out"]
    environment = os.environ | {"VGGTJAX_CACHE": str(tmp_path / "cache"), "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    alone = subprocess.run([*command, str(tmp_path / "alone")], env=environment, capture_output=True, check=False)
    assert alone.returncode == 0, alone.stderr

    out = tmp_path / "out"
    arguments = [*command, str(out), "--engine", "ray", "--address", "local", "--workers", "2"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    done, said, killed = 0, [], False
    with subprocess.Popen(arguments, env=environment, **pipes) as running:
        assert running.stderr is not None
        for line in running.stderr:
            said.append(line)
            done += ": done" in line
            if not killed and done >= 2:
                found = subprocess.run(["pgrep", "-f", "^ray::Worker.run"], capture_output=True, text=True, check=True)
                os.kill(int(found.stdout.split()[0]), signal.SIGKILL)
                killed = True
        table = running.stdout.read()  # type: ignore[union-attr]
    assert running.returncode == 0, said
    assert killed
    assert dict(line.split(maxsplit=1) for line in table.splitlines()[:4]) == {
        "clips": "8",
        "done": "7",
        "kept": "0",
        "failed": "1",
    }
    assert "2 failed: " in table
    assert "1.png" in table
    assert "ray" not in table.lower()
    archives = {path.parent.name: path.read_bytes() for path in (tmp_path / "alone").glob(f"*/{ARCHIVE_NAME}")}
    assert sorted(archives) == [str(number) for number in (0, 1, 3, 4, 5, 6, 7)]
    assert {path.parent.name: path.read_bytes() for path in out.glob(f"*/{ARCHIVE_NAME}")} == archives
    assert (out / SETTINGS_NAME).read_bytes() == (tmp_path / "alone" / SETTINGS_NAME).read_bytes()
    assert {path.name for path in out.iterdir()} == {path.name for path in (tmp_path / "alone").iterdir()}


class Handle:
    """Of a worker, which ends with its last handle."""

    def __init__(self, asked):
        self.ready = self.run = SimpleNamespace(remote=asked)


class FakeRay(SimpleNamespace):
    """Stands for Ray, with two machines of a CPU: `answers` are those of workers, by the name of the clip."""

    def __init__(self, answers):
        self.calls, self.answers, self.options_given = {}, answers, {}
        self.handles, self.at_once = WeakSet(), []  # of workers that are there, and their number at each answer
        super().__init__(init=lambda **_: None, shutdown=lambda: None)

    def nodes(self):
        return [{"Alive": True, "Resources": {"CPU": 1.0}}] * 2

    def remote(self, kind):
        return self

    def options(self, **given):
        self.options_given = given
        return SimpleNamespace(remote=self._worker)

    def _worker(self, *given):
        def asked(*clip):
            self.calls[len(self.calls)] = clip[0] if clip else "ready"
            return len(self.calls) - 1

        self.handles.add(handle := Handle(asked))
        return handle

    def wait(self, calls, timeout):
        return calls[:1], calls[1:]

    def get(self, call):
        name = self.calls[call]
        self.at_once.append(len(self.handles))
        answer = self.answers.get(name, ClipOutcome(name, "done"))
        answer = answer.pop(0) if isinstance(answer, list) else answer
        if isinstance(answer, Exception):
            raise answer
        return answer


READY = (running_versions(), {"size": 56}, "")


def outcomes(monkeypatch, out, answers, said=()):
    """Return the outcomes of clips a to d, by name, and the stand-in for Ray."""
    ray = FakeRay({"ready": READY} | answers)
    for name in ("init", "shutdown", "nodes", "remote", "wait", "get"):
        monkeypatch.setattr(f"ray.{name}", getattr(ray, name))
    notes = list(said)
    sources = {name: f"{name}.mp4" for name in "abcd"}
    made = reconstruct_on_cluster(lambda: (None, None), sources, out, Cluster("ray"), RECIPE, note=notes.append)
    return {outcome.name: outcome for outcome in made}, ray, notes


def test_a_clip_that_ends_a_worker_twice_fails_and_the_others_do_not(monkeypatch, tmp_path):
    from ray.exceptions import RayActorError

    made, ray, notes = outcomes(monkeypatch, tmp_path / "out", {"b": RayActorError()})
    assert {name for name, outcome in made.items() if outcome.status == "done"} == set("acd")
    assert "the worker process died twice on this clip" in made["b"].reason
    assert list(ray.calls.values()) == ["ready", "ready", "a", "b", "c", "d"]  # two workers, a clip each
    assert ray.at_once == [2, 2, 2, 2, 2, 1]  # one ends as no clip waits for it
    assert ray.options_given == {"num_cpus": 1, "num_gpus": 0.0, "max_restarts": -1, "max_task_retries": 1}
    assert notes == ["the first worker is ready"]
    assert json.loads((tmp_path / "out" / SETTINGS_NAME).read_text())["size"] == 56


def test_a_worker_that_never_begins_leaves_the_clips_to_the_others(monkeypatch, tmp_path):
    from ray.exceptions import RayActorError

    made, ray, notes = outcomes(monkeypatch, tmp_path / "out", {"ready": [RayActorError(), READY]})
    assert {outcome.status for outcome in made.values()} == {"done"}
    assert list(ray.calls.values()) == ["ready", "ready", "a", "b", "c", "d"]
    assert ray.at_once[2:] == [1, 1, 1, 1]
    assert notes[0].startswith("a worker ended before it was ready: ")
    assert notes[1:] == ["the first worker is ready"]


def test_urls_need_their_extra_before_any_work(monkeypatch, tmp_path):
    monkeypatch.setattr("vggtjax.errors.find_spec", lambda name: name != "fsspec")
    for source, out in (("s3://bucket/a.mp4", str(tmp_path / "out")), ("a.mp4", "s3://bucket/out")):
        with pytest.raises(MissingExtraError, match="needs the extra 'remote'"):
            next(reconstruct_on_cluster(lambda: (None, None), {"a": source}, out, Cluster("ray"), RECIPE))
    assert not any(tmp_path.iterdir())


def test_workers_of_other_code_and_other_files_and_those_that_cannot_begin(monkeypatch, tmp_path):
    from ray.exceptions import RayActorError, RayTaskError

    other = ("vggtjax 0.0.9 (sources 01234567) with jax 0.9", *READY[1:])
    with pytest.raises(ClusterError, match=r"a worker runs vggtjax 0.0.9 .*, this command vggtjax .* the same"):
        outcomes(monkeypatch, tmp_path / "a", {"ready": other})
    smaller = (READY[0], {"size": 70}, "")
    with pytest.raises(ClusterError, match="two workers have different size"):
        outcomes(monkeypatch, tmp_path / "b", {"ready": [READY, smaller]})
    problem = RayTaskError("ready", "Traceback ...", InputError("no such model"), proctitle="a worker", ip="here")
    with pytest.raises(ClusterError, match="a worker cannot start: no such model"):
        outcomes(monkeypatch, tmp_path / "c", {"ready": problem.as_instanceof_cause()})
    with pytest.raises(ClusterError, match="a worker cannot start: "):
        outcomes(monkeypatch, tmp_path / "d", {"ready": RayActorError()})


@pytest.mark.parametrize(
    ("nodes", "asked", "share"),
    [
        ([{"CPU": 8}, {"CPU": 4}], {}, (3, 4, 0)),
        ([{"CPU": 16, "GPU": 4}, {"CPU": 2}], {}, (4, 1, 1)),
        ([{"CPU": 16, "GPU": 4}], {"worker_gpus": 0.5}, (8, 1, 0.5)),
    ],
)
def test_the_share_of_a_worker(nodes, asked, share):
    assert shared(nodes, Cluster("ray", **asked)) == share


def test_a_worker_does_a_clip_once(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where the worker goes itself
    model = tiny_model()
    Image.fromarray(np.zeros((70, 98, 3), np.uint8)).save(tmp_path / "a.png")
    worker = Worker(lambda: (model, None), RECIPE, LocalFolder(tmp_path / "out"), str(tmp_path), None)
    versions, settings, _ = worker.ready()
    assert (versions, settings["method"]) == (running_versions(), "vggt")
    known = source_setting(open_source("a.png"))
    worker._work.reconstruct_or_cut = lambda name, clip, seconds: make_room(settings=known)  # type: ignore[union-attr]
    assert worker.run("a", "a.png") == ClipOutcome("a", "done", frames=1)
    assert worker.run("a", "a.png").status == "kept"
    Image.fromarray(np.ones((70, 98, 3), np.uint8)).save(tmp_path / "a.png")
    assert worker.run("a", "a.png") == ClipOutcome("a", "done", CHANGED, frames=1)
    assert "'b.png' does not exist" in worker.run("b", "b.png").reason
    worker._work.load = lambda source: 1 / 0  # type: ignore[union-attr]
    assert "ZeroDivisionError" in worker.run("c", "a.png").reason
    with pytest.raises(InputError, match="no such model"):
        Worker(partial(_no_model, "no such model"), RECIPE, LocalFolder(tmp_path), "/nowhere", None).ready()


def _no_model(reason):
    raise InputError(reason)

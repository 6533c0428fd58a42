"""Clips on a cluster of Ray: each good one once, whatever becomes of a worker; a sentence for what is no cluster."""

import os
import re
import signal
import subprocess
import sys
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from tests.batch import dying_driver
from tests.moving_ball import moving_ball
from tests.room import make_room
from tests.tiny import tiny_model
from vggtjax.batch.cluster import _outcomes
from vggtjax.batch.cluster_driver import Dispatcher, _Slot, shared
from vggtjax.batch.cluster_options import Cluster
from vggtjax.batch.cluster_worker import Job, Place, Started, Worker
from vggtjax.batch.destination import SETTINGS_NAME, LocalFolder
from vggtjax.batch.recipe import BatchRecipe, ClipOutcome
from vggtjax.checkpoint import save_model
from vggtjax.errors import ClusterError, InputError
from vggtjax.options import Options
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
    workers, done, said, killed = [], 0, [], False
    with subprocess.Popen(arguments, env=environment, **pipes) as running:
        assert running.stderr is not None
        for line in running.stderr:
            said.append(line)
            workers += map(int, re.findall(r"ready: .*, process (\d+)", line))
            done += ": done" in line
            if not killed and done >= 2 and len(workers) == 2:
                os.kill(workers[0], signal.SIGKILL)
                killed = True
        table = running.stdout.read()  # type: ignore[union-attr]
    assert running.returncode == 0, said
    assert sum("has ended; in its work: " in line for line in said) == 1
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


class Actors:
    """Stands for Ray: remembers what was asked of which worker."""

    def __init__(self, monkeypatch):
        self.answers, self.killed = {}, []
        ray = SimpleNamespace(get=self.get, kill=self.killed.append)
        monkeypatch.setitem(sys.modules, "ray", ray)

    def get(self, reference):
        answer = self.answers[reference]
        if isinstance(answer, Exception):
            raise answer
        return answer


class Actor:
    def __init__(self):
        self.asked = []

    def __getattr__(self, name):
        return SimpleNamespace(remote=partial(self._ask, name))

    def _ask(self, name, *arguments):
        self.asked.append(name)
        return (id(self), len(self.asked))


def job(load, out, folder="."):
    return Job(load, RECIPE, LocalFolder(out), folder, Cluster("ray", workers=2))


@pytest.fixture
def dispatcher(monkeypatch, tmp_path):
    """Return a dispatcher of five clips with two workers that are ready, and what it has sent."""
    actors, sent = Actors(monkeypatch), []
    dispatcher = Dispatcher(job(dying_driver.no_model, tmp_path), {name: name for name in "abcde"}, sent.append)
    it = SimpleNamespace(it=dispatcher, actors=actors, sent=sent)
    dispatcher.begin([Actor(), Actor()])
    for slot in dispatcher._slots:
        begin(it, slot)
    return it


def begin(dispatcher, slot):
    """Let a worker answer where it is, and that it is ready."""
    end(dispatcher, slot, None, Place("host", dispatcher.it._slots.index(slot), running_versions()))
    end(dispatcher, slot, None, Started({"size": 56}, ""))


def end(dispatcher, slot, name, answer):
    """Let a worker answer for a clip."""
    reference = next(key for key, task in dispatcher.it._tasks.items() if task == (slot, name))
    dispatcher.actors.answers[reference] = answer
    dispatcher.it.finish(reference)


def test_a_clip_that_ends_two_workers_fails_and_those_beside_it_do_not(dispatcher):
    from ray.exceptions import RayActorError

    it = dispatcher.it
    it.assign()
    first, second = it._slots
    assert (first.clips, second.clips) == (["a", "c", "e"], ["b", "d"])
    end(dispatcher, first, "c", RayActorError())
    assert dispatcher.sent[-1] == "a worker (host, process 0) has ended; in its work: a, c, e"
    again = it._slots[1]
    assert again.actor is first.actor  # which Ray begins anew
    begin(dispatcher, again)
    it.assign()
    assert again.clips == ["a"]  # alone, so that another end tells which clip it is
    end(dispatcher, again, "a", ClipOutcome("a", "kept"))
    assert dispatcher.sent[-1] == ClipOutcome("a", "done")  # the first worker had written it
    it.assign()
    assert again.clips == ["c"]
    end(dispatcher, again, "c", RayActorError())
    (outcome,) = [sent for sent in dispatcher.sent if getattr(sent, "status", "") == "failed"]
    assert outcome.name == "c"
    assert "two workers ended with it in their work" in outcome.reason
    assert list(it._again) == ["e"]
    assert second.clips == ["b", "d"]
    assert dispatcher.actors.killed == []


def test_a_worker_that_never_begins_is_given_up(dispatcher):
    from ray.exceptions import RayActorError

    it = dispatcher.it
    it._slots.clear()
    it.begin([Actor()])
    for _ in range(2):
        end(dispatcher, it._slots[0], None, RayActorError())
    with pytest.raises(ClusterError, match="workers ended 3 times in a row before they began"):
        end(dispatcher, it._slots[0], None, RayActorError())
    assert len(dispatcher.actors.killed) == 1


def test_workers_of_other_code_and_other_files_are_refused(dispatcher):
    from ray.exceptions import RayTaskError

    slot = _Slot(Actor())
    dispatcher.it._tasks["x"] = (slot, None)
    with pytest.raises(
        ClusterError, match=r"\(far, process 7\) runs vggtjax 0.0.9 .*, this command vggtjax .* the same"
    ):
        end(dispatcher, slot, None, Place("far", 7, "vggtjax 0.0.9 (sources 01234567) with jax 0.9"))
    slot.place = Place("far", 7, running_versions())
    dispatcher.it._tasks["x"] = (slot, None)
    with pytest.raises(ClusterError, match="has another size than the one on host, process 0"):
        end(dispatcher, slot, None, Started({"size": 70}, ""))
    dispatcher.it._tasks["x"] = (slot, None)
    problem = RayTaskError("start", "Traceback ...", InputError("no such model"), proctitle="a worker", ip="here")
    with pytest.raises(ClusterError, match="cannot begin: no such model"):
        end(dispatcher, slot, None, problem.as_instanceof_cause())


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
    worker = Worker()
    assert worker.place() == Place(os.uname().nodename, os.getpid(), running_versions())
    started = worker.start(job(lambda: (model, None), tmp_path / "out", str(tmp_path)))
    assert isinstance(started, Started)
    assert started.settings["method"] == "vggt"
    worker._work.reconstruct_or_cut = lambda name, clip, seconds: make_room()  # type: ignore[union-attr]
    assert worker.run("a", "a.png") == ClipOutcome("a", "done", frames=1)
    assert worker.run("a", "a.png").status == "kept"
    assert "'b.png' does not exist" in worker.run("b", "b.png").reason
    worker._work.load = lambda source: 1 / 0  # type: ignore[union-attr]
    assert "ZeroDivisionError" in worker.run("c", "a.png").reason
    worker.close()
    with pytest.raises(InputError, match="no such model"):
        Worker().start(job(partial(_no_model, "no such model"), tmp_path, "/nowhere"))


def _no_model(reason):
    raise InputError(reason)


def test_a_driver_that_dies_is_one_sentence(monkeypatch, tmp_path):
    monkeypatch.setattr("vggtjax.batch.cluster.drive", dying_driver.die)
    with pytest.raises(ClusterError, match=r"the cluster has died \(Ray's last words: GCS is gone\); finished clips"):
        list(_outcomes(job(dying_driver.no_model, tmp_path), {}, print))

"""The jobs of the app, without a browser: checked uploads, one job at a time, cancel, bounded results."""

import os
import threading
import time
import zipfile
from pathlib import Path

import pytest
from PIL import Image

from tests.room import make_room
from tests.videos import write_video
from vggtjax.app import outputs
from vggtjax.app.jobs import Desk, Job, Request
from vggtjax.app.limits import Limits
from vggtjax.app.models import Models
from vggtjax.app.uploads import check_clip, clip_of, room_for, safe_stem
from vggtjax.errors import ClipError, InputError, ResultError


@pytest.fixture
def desk(tmp_path):
    """A desk whose jobs end when they are told to; `release` holds one event for each."""
    desks = []

    def make(run=None, **limits) -> Desk:
        desks.append(Desk(tmp_path / "app", Models(()), Limits(**limits), run or (lambda *_: None)))
        return desks[-1]

    yield make
    for made in desks:
        made.close()


def wait(job: Job, state: str, seconds: float = 10) -> None:
    end = time.monotonic() + seconds
    while job.state != state:
        assert time.monotonic() < end, job.state
        time.sleep(0.005)


def held(release: threading.Event):
    """Return the work of a job that takes steps until it is released."""

    def run(job, models, limits):
        with job.on_stage("hold") as progress:
            while not release.wait(0.005):
                progress(1, 2)

    return run


def test_the_second_job_waits_for_the_first(desk):
    release = threading.Event()
    made = desk(held(release), max_waiting=2)
    first, second, third = (made.submit(Request((), "demo"), owner) for owner in "abc")
    wait(first, "running")
    assert [made.ahead(job) for job in (first, second, third)] == [0, 1, 2]
    with pytest.raises(InputError, match="the queue is full, with 2 waiting"):
        made.submit(Request((), "demo"), "d")
    assert second.state == "waiting"
    made.cancel("b")
    assert second.state == "cancelled"  # at once
    assert made.ahead(third) == 1
    release.set()
    wait(third, "done")


def test_a_running_job_is_cancelled_at_its_next_step(desk):
    made = desk(held(threading.Event()))
    job = made.submit(Request((), "demo"), "a")
    wait(job, "running")
    made.cancel("somebody else")
    with pytest.raises(InputError, match="earlier job is not over"):
        made.submit(Request((), "demo"), "a")
    assert job.state == "running"
    made.cancel("a")
    wait(job, "cancelled")
    assert not job.folder.exists()


def test_old_results_go(desk):
    made = desk(lambda job, *_: job.folder.mkdir(), max_results=2)
    jobs = []
    for _ in range(4):
        jobs.append(made.submit(Request((), "demo"), "a"))
        wait(jobs[-1], "done")
    assert [job.folder.exists() for job in jobs] == [False, False, True, True]


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ResultError("frame 3 is broken; send it again"), "frame 3 is broken; send it again"),
        (OSError(28, "No space left on device"), "results cannot be written"),
        (ZeroDivisionError("secret"), "the program failed"),
    ],
)
def test_a_failure_is_one_sentence(desk, error, said):
    def run(job, models, limits):
        raise error

    job = desk(run).submit(Request((), "demo"), "a")
    wait(job, "failed")
    assert said in job.message
    assert "secret" not in job.message


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (["a.txt"], "a.txt: by its name this is no video and no picture"),
        (["a.mp4", "b.png"], "2 files with a video among them"),
        (["../../conftest.py"], "the upload is not here any more"),
    ],
)
def test_an_upload_that_is_no_clip_is_refused(desk, names, said):
    made = desk()
    for name, content in (("a.txt", b"words"), ("a.mp4", b"words"), ("b.png", b"")):
        (made.uploads / name).write_bytes(content)
    with pytest.raises(InputError, match=said):
        made.submit(Request(tuple(made.uploads / name for name in names), "demo"), "a")
    assert not any(made.results.iterdir())


@pytest.mark.usefixtures("tiny_demo")
def test_the_demo_clip_leaves_everything_to_download(tmp_path, monkeypatch):
    asked = []  # the network has tests of its own

    def reconstruct(model, clip, **options):
        asked.append((clip.images.shape, options["method"], options["consistent_depth"]))
        return make_room(len(clip.images))

    monkeypatch.setattr("vggtjax.pipeline.run.reconstruct", reconstruct)
    monkeypatch.setattr(outputs, "_FILM_SECONDS", 0.2)
    monkeypatch.setattr(outputs, "_FILM_SIZE", (64, 36))
    made = Desk(tmp_path / "app", Models(()), Limits())
    job = made.submit(Request((), "demo", "vggt", frames=4), "a")
    try:
        wait(job, "done", seconds=30)
        assert job.outputs is not None
        with zipfile.ZipFile(job.outputs.archive) as archive:
            names = {Path(name).name for name in archive.namelist()}
    finally:
        made.close()
    assert asked == [((4, 96, 96, 3), "vggt", True)]
    assert names >= {"reconstruction.npz", "report.html", "scene.glb", "film.mp4", "layers.mp4", "sheet.png"}


def test_a_file_that_is_no_video_fails_without_the_machines_paths(tmp_path):
    made = Desk(tmp_path / "app", Models(()), Limits())
    (made.uploads / "holiday.mp4").write_bytes(b"words")
    job = made.submit(Request((made.uploads / "holiday.mp4",), "demo"), "a")
    wait(job, "failed")
    made.close()
    assert "cannot read video holiday.mp4" in job.message
    assert str(tmp_path) not in job.message


def test_a_long_video_is_refused_and_a_short_one_is_sampled_evenly(tmp_path):
    video = write_video(tmp_path / "a.mp4", range(0, 4000, 250))
    with pytest.raises(InputError, match="the video is 4 s long; send at most 3 s"):
        check_clip(video, 8, None, Limits(max_seconds=3))
    for rate, times in ((None, [0, 1, 2, 3]), (2.0, [0, 0.5, 1, 1.5])):
        source, sampling = check_clip(video, 4, rate, Limits())
        assert [frame.time for frame in source.frames(sampling)] == times


def test_the_oldest_uploads_go_where_room_is_needed_and_those_of_the_last_hour_stay(tmp_path):
    for age, name in ((90_000, "old.png"), (7200, "cut.tmp"), (60, "new.png")):
        (tmp_path / name).write_bytes(bytes(100))
        then = time.time() - age
        os.utime(tmp_path / name, (then, then))
    assert room_for(tmp_path, 50, 1000)
    assert len(list(tmp_path.iterdir())) == 3
    assert room_for(tmp_path, 50, 260)
    assert {path.name for path in tmp_path.iterdir()} == {"cut.tmp", "new.png"}
    assert not room_for(tmp_path, 50, 100)
    assert {path.name for path in tmp_path.iterdir()} == {"new.png"}
    (tmp_path / "new.png").write_bytes(bytes(600_000))
    with pytest.raises(ClipError, match=r"has 1\.2 MB; send at most 1 MB"):
        clip_of([tmp_path / "new.png"] * 2, tmp_path, Limits(max_upload_mb=1))


def test_pictures_keep_their_order_and_results_have_safe_names(tmp_path):
    uploads = tmp_path / "uploads"
    uploads.mkdir()
    paths = [uploads / f"frame {number}.png" for number in range(11)]
    for path in paths:
        Image.new("RGB", (28, 28), "teal").save(path)
    kept = clip_of(sorted(paths), uploads, Limits())
    assert kept == tuple(paths)
    source, sampling = check_clip(kept, 4, 7.0, Limits())
    assert len(list(source.frames(sampling))) == 4
    assert [safe_stem(name) for name in ("../<b>..mp4", "....")] == ["b", "clip"]

import av
import pytest
from PIL import Image

from tests.shared import command
from tests.shared.room import make_room


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("render") / "result"
    make_room(3).save(folder)
    return folder


def run(capsys, *arguments):
    return command.run(capsys, "render", *arguments, "--seconds", 0.5, "--fps", 8)


def test_a_film_beside_the_previews(result, capsys):
    code, out, _ = run(capsys, result, "--size", "96x54")
    film = result / "preview" / "turntable.mp4"
    assert code == 0
    assert str(film) in out
    with av.open(str(film)) as container:
        assert sum(1 for _ in container.decode(video=0)) == 4
    make_room(2).save(result)  # a film of the earlier result goes with it
    assert not film.exists()


def test_a_gif_elsewhere_along_the_camera(result, tmp_path, capsys):
    how = ("--size", "96x54", "--path", "camera", "--out", tmp_path / "a.gif")
    assert run(capsys, result / "reconstruction.npz", *how)[0] == 0
    with Image.open(tmp_path / "a.gif") as film:
        assert film.size == (96, 54)


def test_an_existing_film_is_replaced_on_request_and_the_result_never(result, tmp_path, capsys):
    film = tmp_path / "mine.webp"
    film.write_bytes(b"mine")
    assert run(capsys, result, "--size", "32x18", "--out", film)[0] == 2
    assert film.read_bytes() == b"mine"
    assert run(capsys, result, "--size", "32x18", "--out", film, "--overwrite")[0] == 0
    assert film.stat().st_size > 100
    part = next((result / "preview").glob("*.webp"), None) or result / "preview" / "own.webp"
    part.write_bytes(b"part")
    linked = tmp_path / "link.webp"
    linked.symlink_to(part)
    for out in (part, linked):
        code, _, err = run(capsys, result, "--out", out, "--overwrite")
        assert (code, "is part of the result in" in err, part.read_bytes()) == (2, True, b"part")
    for _ in range(2):  # the film at its usual place is one of this command
        assert run(capsys, result, "--size", "32x18")[0] == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{tmp}"], "there is no {tmp}/reconstruction.npz; give the folder of a saved result or its"),
        (["{result}", "--out", "{tmp}/a.avi"], "{tmp}/a.avi has no known ending of a film; expected one of .mp4"),
        (["{result}", "--out", "{tmp}/no/a.gif"], "there is no folder {tmp}/no for the film; make it, or choose"),
    ],
)
def test_bad_input(result, tmp_path, capsys, arguments, message):
    places = {"tmp": tmp_path, "result": result}
    words = [argument.format(**places) for argument in arguments]
    assert message.format(**places) in command.refusal(capsys, "render", *words)
    assert list(tmp_path.iterdir()) == []

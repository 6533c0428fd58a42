"""The page of a batch: a card per finished clip, a sentence per failure, and nothing that a name could run."""

import shutil

import numpy as np

from tests.results.test_report import Reader
from tests.shared.chromium import browser, look
from tests.shared.room import make_room
from vggtjax.pipeline.batch.contact import ContactPage
from vggtjax.pipeline.batch.destination import PAGE_NAME

NAMES = ["dog", "<script>alert(1)<", "a#b?c%20 é"]


def text_of(folder):
    return (folder / PAGE_NAME).read_text(encoding="utf-8")


def test_every_clip_has_a_card_and_every_failure_a_sentence(tmp_path):
    for name in NAMES:
        make_room().save(tmp_path / name)
    for file in ("report.html", "preview/card.webp"):
        (tmp_path / "dog" / file).unlink()  # as earlier versions leave a folder
    (tmp_path / "broken").mkdir()
    np.savez(tmp_path / "broken" / "reconstruction.npz", format_version=1, depth=np.zeros(3), camera_from_world=1)
    page = ContactPage(tmp_path, 5)
    page.add("dog")
    page.add("cat", "<img src=x onerror=alert(2)> cannot be read")
    text = text_of(tmp_path)
    assert "4 clips, 1 failed, 3 to come" in text
    assert "3 frames of 42 x 28 pixels, " in text
    assert 'href="./dog/preview/sheet.png"' in text
    assert "cannot be read: " in text
    assert "http:" not in text.replace("http-equiv", "")
    tags = Reader(text).tags
    assert "script" not in {tag for tag, _ in tags}
    assert all(attributes["src"].startswith("./") for tag, attributes in tags if tag == "img")
    script = """async () => {
        const decoded = [...document.images].map(image => { image.loading = "eager"; return image.decode(); });
        const pictures = (await Promise.allSettled(decoded)).filter(result => result.status == "fulfilled").length;
        const titles = [...document.querySelectorAll("h2 a")].map(link => link.textContent);
        return [document.documentElement.scrollWidth, pictures, titles];
    }"""
    with browser() as opened:
        (wide, pictures, titles), events = look(opened, tmp_path / PAGE_NAME, 400, script)
    assert wide <= 400
    assert pictures == 3
    assert titles == sorted([*NAMES, "broken"])
    assert all(event.startswith(tmp_path.as_uri()) for event in events)  # the pictures
    shutil.rmtree(tmp_path / "dog")
    ContactPage(tmp_path, 0)
    assert "dog" not in text_of(tmp_path)

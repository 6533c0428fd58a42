"""The report of a result: everything in it is shown, nothing of it is run, nothing is loaded from elsewhere."""

import re
from html.parser import HTMLParser

import numpy as np
import pytest

from tests.shared.room import make_room
from vggtjax.results import charts
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.results.report import REPORT_NAME, ErrorTable, RunFacts, report_page
from vggtjax.storage.markup import write_page

HOSTILE = "<script>alert('1')</script><img src=x onerror=alert(2)>\"'&\n\u202e\ud800"
TEXTS = {"html", "head", "meta", "title", "style", "body", "main", "header", "section", "div", "span", "p", "b", "code"}
PARTS = {"h1", "h2", "h3", "picture", "source", "table", "tr", "th", "td", "ul", "li", "a", "img", "input", "label"}
DRAWN = {"svg", "path", "circle", "text"}


class Reader(HTMLParser):
    """Tags with their attributes, and the text between them."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.texts = [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.texts.append(data)


def report(tmp_path, result, facts=None):
    write_page(tmp_path / REPORT_NAME, report_page(tmp_path, result, facts))
    text = (tmp_path / REPORT_NAME).read_text(encoding="utf-8")
    return text, Reader(text)


@pytest.fixture
def hostile():
    """A result in which every text is a stranger's."""
    settings = {"clip": HOSTILE, "model_note": HOSTILE, "missing": [HOSTILE], HOSTILE: {HOSTILE: HOSTILE}}
    settings |= {"versions": {HOSTILE: HOSTILE}}
    names = {"method": HOSTILE, "model_name": HOSTILE, "frame_names": (HOSTILE,) * 3}
    facts = RunFacts({HOSTILE: 1.5}, ErrorTable((HOSTILE,), ((HOSTILE,),), HOSTILE), np.zeros((9, 9, 3), np.uint8))
    return make_room(**names, settings=settings), facts


def test_it_shows_the_clip_the_method_and_the_numbers(tmp_path):
    settings = {"clip": "dog", "mask_pairs": 5, "versions": {"jax": "0.9"}}
    facts = RunFacts({"first pass": 2.25}, ErrorTable(("method", "AbsRel"), (("vggt", "0.453"),)))
    _, page = report(tmp_path, make_room(settings=settings), facts)
    for text in ("dog", "3 of 42 x 28 pixels", "mask_pairs", "jax", "0.9", "2.25 s", "0.453", "0.00 s to 0.08 s"):
        assert any(text in shown for shown in page.texts), text
    pictures = [attributes["src"] for tag, attributes in page.tags if tag == "img"]
    assert len(pictures) >= 4 * 3
    assert all(source.startswith("data:image/webp;base64,") for source in pictures)
    links = [attributes["href"] for tag, attributes in page.tags if tag == "a"]
    assert links == ["./reconstruction.npz"]  # nothing else is in the folder


def test_texts_of_strangers_are_shown_and_not_run_and_nothing_is_loaded(tmp_path, hostile):
    text, page = report(tmp_path, *hostile)
    assert {tag for tag, _ in page.tags} == TEXTS | PARTS | DRAWN
    assert not any(name.startswith("on") for _, attributes in page.tags for name in attributes)
    assert any("<script>alert('1')</script>" in shown for shown in page.texts)
    assert "\u202e" not in text
    assert len(text) < 400_000
    assert not re.search(r"https?:|@import|url\(|//", re.sub(r"data:image/webp;base64,[\w+/=]+", "", text))
    heads = [attributes for tag, attributes in page.tags if tag == "meta"]
    (policy,) = [head["content"] for head in heads if head.get("http-equiv") == "Content-Security-Policy"]
    assert policy.startswith("default-src 'none'; img-src data:;")
    assert report(tmp_path, *hostile)[0] == text  # equal results give equal bytes


@pytest.mark.parametrize(
    "changes",
    [
        {"dynamic_mask": np.ones((2, 28, 42), bool), "saliency": None, "timestamps": None},
        {"depth": np.zeros((2, 28, 42), np.float32)},
        {"camera_from_world": np.stack([np.eye(3, 4), np.c_[np.eye(3), [3e38] * 3]]).astype(np.float32)},
        {"depth": np.full((2, 28, 42), 1e30, np.float32), "depth_confidence": np.full((2, 28, 42), 1e-30, np.float32)},
    ],
)
def test_odd_results_have_a_report(tmp_path, changes):
    text, _ = report(tmp_path, make_room(2, **changes))
    assert "nan" not in re.sub(r"base64,[\w+/=]+", "", text)


def test_a_report_that_fails_costs_no_result(tmp_path, monkeypatch, caplog):
    def broken(*_):
        raise ValueError("a chart\nof nothing")

    make_room(1).save(tmp_path, only=("cameras",))
    monkeypatch.setattr(charts, "camera_views", broken)
    make_room(2).save(tmp_path)
    assert len(Reconstruction.load(tmp_path).depth) == 2
    assert not (tmp_path / REPORT_NAME).exists()
    assert "saved without report.html, which could not be made (ValueError: a chart of nothing)" in caplog.text


def test_the_path_by_hand():
    """A camera that goes 2 to the right and 1 forward, seen from above: right is right, forward is up."""
    poses = np.tile(np.eye(3, 4, dtype=np.float32), (3, 1, 1))
    poses[:, 0, 3], poses[:, 2, 3] = (0, -1, -2), (0, 0, -1)
    above, side = charts.camera_views(make_room(camera_from_world=poses))
    assert (above["title"], side["title"]) == ("From above", "From the side")
    places = np.array([[float(x) for x in re.findall(r"-?[\d.]+", step)] for step, _ in above["way"]])
    (x0, y0, x1, y1), (_, _, x2, y2) = places
    assert (x2 - x1) == pytest.approx(x1 - x0, abs=0.2)
    assert y1 == pytest.approx(y0, abs=0.2)
    assert (y1 - y2) == pytest.approx(x2 - x1, abs=0.2)

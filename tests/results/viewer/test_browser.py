"""The page in a real browser: it opens from a file, plays, and shows the frame that is due."""

import dataclasses
import io
from functools import partial

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from tests.shared import chromium
from tests.shared.room import make_room
from vggtjax.results.viewer.page import viewer_page

FRAMES, HEIGHT, WIDTH = 6, 28, 42
BAR = 46  # pixels of the time line
SCREEN = {"width": 630, "height": 420 + BAR}  # the scene has the shape of a frame
NAME = "</script><img src=x onerror=\"document.title='broken'\">"


def until(condition):
    """Return JavaScript that waits for a minute: the page's policy forbids what playwright's own waiting does."""
    wait = f"{condition} ? done(true) : performance.now() < end ? setTimeout(look, 20) : fail(new Error('too late'))"
    start = "const end = performance.now() + 60000"
    return f"new Promise((done, fail) => {{ {start}; const look = () => {{ {wait} }}; look() }})"


READY = until("window.vggtjax")
DRAWN = until("window.vggtjax.viewer.settledAt === null && !window.vggtjax.viewer.wanted")


@pytest.fixture(scope="module")
def room():
    return make_room(FRAMES, HEIGHT, WIDTH)


@pytest.fixture(scope="module")
def browser():
    with chromium.browser(webgl=True) as opened:
        yield opened


@pytest.fixture
def page(browser):
    page = browser.new_page(viewport=SCREEN, reduced_motion="reduce")
    page.complaints, page.asked = [], []
    page.on("pageerror", lambda error: page.complaints.append(str(error)))
    page.on("console", lambda line: page.complaints.append(line.text) if line.type == "error" else None)
    page.on("request", lambda request: page.asked.append(request.url))
    yield page
    page.close()


def pixels_of(page):
    """Return the pixels above the time line."""
    shot = page.screenshot(clip={"x": 0, "y": 0, "width": 630, "height": 420})
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"), int)


def red(page):
    """Return the pixels of the moving box on the screen, at the size of a frame."""
    page.evaluate(DRAWN)
    pixels = pixels_of(page)
    found = (pixels[..., 0] > 150) & (pixels[..., 1] < 90) & (pixels[..., 2] < 90)
    return found.reshape(HEIGHT, 420 // HEIGHT, WIDTH, 630 // WIDTH).mean(axis=(1, 3)) > 0.5


def agreement(shown, mask):
    """Return the intersection over union with a mask; the box's rim, a step of depth, is left out of the scene."""
    box = ndimage.binary_erosion(mask)
    return (shown & box).sum() / (shown | box).sum()


def set_slider(page, name, value):
    page.locator(name).evaluate("(one, value) => { one.value = value; one.dispatchEvent(new Event('input')) }", value)


def open_page(page, folder, results, **options):
    file = folder / "viewer.html"
    file.write_text(viewer_page(results, **options), encoding="utf-8")
    page.goto(file.as_uri())
    page.evaluate(READY)


def test_the_page_opens_from_a_file_plays_and_shows_the_frame_that_is_due(page, room, tmp_path):
    open_page(page, tmp_path, [room], names=[NAME])
    assert NAME.startswith(page.locator("h1").inner_text()[:20])
    assert page.title() == NAME

    page.keyboard.press("Space")
    page.evaluate(until("window.vggtjax.viewer.frame > 0"))
    page.keyboard.press("Space")
    assert not page.evaluate("window.vggtjax.viewer.playing")

    set_slider(page, "#least-moving", 0)
    page.locator("#pictures").evaluate("box => box.click()")
    page.keyboard.press("f")  # through the clip's camera the scene is the picture
    for frame in (0, FRAMES // 2, FRAMES - 1):
        set_slider(page, "#time", frame)
        assert agreement(red(page), room.dynamic_mask[frame]) > 0.75
        assert page.locator("#moment").inner_text().startswith(f"frame {frame} of {FRAMES - 1}")
    with page.expect_download() as download:
        page.keyboard.press("p")
    with Image.open(download.value.path()) as picture:
        assert picture.size == (630, 420)
    assert page.complaints == []
    assert [url for url in page.asked if not url.startswith(("file:", "data:", "blob:"))] == []


def test_two_results_side_by_side_and_swapped_by_a_key(page, room, tmp_path):
    theirs = make_room(FRAMES, HEIGHT, WIDTH, method="vggt")
    open_page(page, tmp_path, [room, theirs], names=["ours", "theirs"])
    page.keyboard.press("v")
    page.locator("#pictures").evaluate("box => box.click()")
    both = red(page)
    assert both[:, : WIDTH // 2].any()
    assert both[:, WIDTH // 2 :].any()
    page.keyboard.press("2")
    assert page.locator("h1").inner_text() == "theirs"
    assert "pass" not in page.locator("#color option").all_inner_texts()
    assert page.complaints == []


BRIGHT, DARK = (64, 255, 242), (5, 13, 26)  # the rims of the halo


def rims(page):
    """Return the number of pixels of each rim."""
    pixels = pixels_of(page)
    return [np.count_nonzero(np.abs(pixels - color).max(axis=-1) < 4) for color in (BRIGHT, DARK)]


def test_the_first_view_swings_and_what_moves_has_a_halo_until_the_first_touch(browser, room, tmp_path):
    page = browser.new_page(viewport=SCREEN, reduced_motion="no-preference")
    open_page(page, tmp_path, [room])
    page.evaluate("window.vggtjax.viewer.adapt = () => {}")  # however slowly this machine draws
    first = page.evaluate("window.vggtjax.viewer.orbit.yaw")
    page.evaluate(until(f"Math.abs(window.vggtjax.viewer.orbit.yaw - {first}) > 0.02"))
    page.evaluate("window.vggtjax.welcome.rest()")  # the swing ends by itself, the halo does not
    assert min(rims(page)) > 100
    page.keyboard.press("h")
    yaw = page.evaluate("window.vggtjax.viewer.orbit.yaw")
    page.evaluate(until("window.vggtjax.viewer.halo === 0"))
    assert page.evaluate("window.vggtjax.viewer.orbit.yaw") == yaw
    page.close()


@pytest.mark.parametrize("touch", ["wheel", "pointer", "key"])
def test_where_nothing_is_to_move_by_itself_the_halo_is_still_there(page, room, tmp_path, touch):
    open_page(page, tmp_path, [room])
    page.evaluate(DRAWN)
    page.mouse.move(300, 200)  # is no touch
    assert min(rims(page)) > 100
    wheel, key = partial(page.mouse.wheel, 0, 30), partial(page.keyboard.press, "x")
    {"wheel": wheel, "pointer": page.mouse.down, "key": key}[touch]()
    page.evaluate(until("window.vggtjax.viewer.halo === 0"))
    page.evaluate(DRAWN)
    assert max(rims(page)) < 20


def test_a_result_in_which_nothing_moves_has_no_halo(page, room, tmp_path):
    still = dataclasses.replace(room, dynamic_mask=np.zeros_like(room.dynamic_mask))
    open_page(page, tmp_path, [still])
    page.evaluate(DRAWN)
    assert max(rims(page)) < 20

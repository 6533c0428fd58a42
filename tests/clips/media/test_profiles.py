"""Pictures with ICC profiles; the profiles are made here, after ICC.1:2001-04 (matrix and curves)."""

import struct

import numpy as np
import pillow_heif
import pytest
from PIL import Image, ImageCms

from vggtjax import load_clip
from vggtjax.clips.media.images import read_image
from vggtjax.errors import ClipError

BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
D50, D65 = np.array([0.9642, 1.0, 0.8249]), np.array([0.95047, 1.0, 1.08883])
TO_D50 = np.linalg.solve(BRADFORD, np.diag((BRADFORD @ D50) / (BRADFORD @ D65)) @ BRADFORD)
# x, y of red, green and blue; exponent of the curve.
SPACES = {
    "Display P3": (((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)), 2.2),
    "Adobe RGB (1998)": (((0.64, 0.33), (0.21, 0.71), (0.15, 0.06)), 563 / 256),
    "ProPhoto": (((0.7347, 0.2653), (0.1596, 0.8404), (0.0366, 0.0001)), 1.8),
}
GREEN = (60, 170, 70)


def to_xyz(space):
    """Return the matrix from linear values to XYZ under D65."""
    columns = np.array([[x / y, 1, (1 - x - y) / y] for x, y in SPACES[space][0]]).T
    return columns * np.linalg.solve(columns, D65)


def fixed(*values):
    """Return numbers as ICC's s15Fixed16."""
    return struct.pack(f">{len(values)}i", *(round(value * 65536) for value in values))


def profile(name, columns, gamma, space=b"RGB "):
    """Return an ICC profile: columns [3, 3] are the colorants under D50; a grey one has its curve alone."""
    text = name.encode() + b"\0"
    curve = b"curv" + bytes(4) + struct.pack(">IH", 1, round(gamma * 256)) + bytes(2)
    tags = {
        b"desc": b"desc" + bytes(4) + struct.pack(">I", len(text)) + text + bytes(78),
        b"cprt": b"text" + bytes(4) + b"none\0",
        b"wtpt": b"XYZ " + bytes(4) + fixed(*D50),
    }
    if space == b"RGB ":
        tags |= {b"rgb"[i : i + 1] + b"XYZ": b"XYZ " + bytes(4) + fixed(*columns[:, i]) for i in range(3)}
        tags |= {b"rgb"[i : i + 1] + b"TRC": curve for i in range(3)}
    else:
        tags |= {b"kTRC": curve}
    table, body, start = struct.pack(">I", len(tags)), b"", 128 + 4 + 12 * len(tags)
    for tag, value in tags.items():
        table += tag + struct.pack(">II", start + len(body), len(value))
        body += value + bytes(-len(value) % 4)
    header = struct.pack(">I4sI4s4s4s12x4s", start + len(body), bytes(4), 0x02100000, b"mntr", space, b"XYZ ", b"acsp")
    return header + bytes(28) + fixed(*D50) + bytes(128 - len(header) - 40) + table + body


def in_space(srgb, space):
    """Return sRGB in 8 bits as values of a space in 8 bits."""
    values = np.array(srgb) / 255
    light = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    srgb_to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    linear = np.linalg.solve(to_xyz(space), srgb_to_xyz @ light)
    return tuple(np.rint(255 * linear.clip(0, 1) ** (1 / SPACES[space][1])).astype(int).tolist())


def stored(space):
    """Return the profile of a space."""
    return profile(space, TO_D50 @ to_xyz(space), SPACES[space][1])


@pytest.mark.parametrize(
    ("space", "ending"),
    [("Display P3", ".jpg"), ("Adobe RGB (1998)", ".tif"), ("ProPhoto", ".png"), ("Display P3", ".webp"),
     ("Adobe RGB (1998)", ".heic"), ("Display P3", ".avif")],
)  # fmt: skip
def test_a_colour_is_what_the_profile_says(tmp_path, caplog, space, ending):
    pillow_heif.register_heif_opener()
    pixels = in_space(GREEN, space)
    assert np.abs(np.array(pixels) - GREEN).max() > 15  # as it would be read without the profile
    path = tmp_path / f"a{ending}"
    Image.new("RGB", (64, 64), pixels).save(path, icc_profile=stored(space), quality=100)
    assert np.abs(np.asarray(read_image(path, set())).astype(int) - GREEN).max() <= 6  # the codecs lose some
    assert [f"profile '{space}'; its colours are converted to sRGB" in text for text in caplog.messages] == [True]


def test_transparency_lies_over_white(tmp_path):
    picture = Image.new("RGBA", (8, 8), (*in_space(GREEN, "Display P3"), 255))
    picture.paste((0, 0, 0, 0), (0, 0, 8, 4))
    picture.save(tmp_path / "a.png", icc_profile=stored("Display P3"))
    pixels = np.asarray(read_image(tmp_path / "a.png")).astype(int)
    assert np.abs(pixels[:4] - 255).max() <= 1
    assert np.abs(pixels[4:] - GREEN).max() <= 4


@pytest.mark.parametrize("mode", ["L", "LA", "I;16"])
def test_grey_has_the_curve_of_its_profile(tmp_path, mode):
    value = round(255 * 0.5**0.5556)
    picture = Image.new("L", (8, 8), value)
    if mode == "I;16":
        picture = Image.fromarray(np.full((8, 8), 257 * value, np.uint16))
    picture.convert(mode).save(tmp_path / "a.png", icc_profile=profile("Gray 1.8", None, 1.8, b"GRAY"))
    assert np.abs(np.asarray(read_image(tmp_path / "a.png")).astype(int) - 188).max() <= 1  # half the light of white


def test_grey_pictures_have_profiles_of_colours_too(tmp_path, caplog):
    linear = profile("linear sRGB", TO_D50 @ to_xyz("Display P3"), 1.0)  # whatever its name says
    Image.new("L", (64, 64), 55).save(tmp_path / "a.jpg", icc_profile=linear, quality=100)
    assert np.abs(np.asarray(read_image(tmp_path / "a.jpg", set())).astype(int) - 128).max() <= 2
    assert "'linear sRGB'; its colours are converted" in caplog.text


def test_a_profile_of_another_kind_of_picture_is_said_to_be_unused(tmp_path, caplog):
    Image.new("CMYK", (8, 8), (0, 128, 0, 0)).save(tmp_path / "a.tif", icc_profile=stored("Display P3"))
    read_image(tmp_path / "a.tif", set())
    assert "is CMYK and its colour profile is of RGB; it is not used" in caplog.text


@pytest.mark.parametrize("ending", [".webp", ".png"])
def test_animations_have_profiles(tmp_path, caplog, ending):
    frames = [Image.new("RGB", (42, 42), in_space((60, green, 70), "Display P3")) for green in (170, 150)]
    path = tmp_path / f"a{ending}"
    frames[0].save(path, save_all=True, append_images=frames[1:], icc_profile=stored("Display P3"), lossless=True)
    clip = load_clip(path, size=42)
    assert np.abs(255 * np.asarray(clip.images)[:, 20, 20] - [(60, 170, 70), (60, 150, 70)]).max() <= 4
    assert caplog.text.count("are converted to sRGB") == 1


@pytest.mark.parametrize("broken", [b"no profile", stored("Display P3")[:200], bytes(1 << 23)])
def test_a_broken_profile_is_said_and_changes_nothing(tmp_path, caplog, broken):
    Image.new("RGB", (64, 64), GREEN).save(tmp_path / "a.webp", icc_profile=broken, lossless=True)
    assert (np.asarray(read_image(tmp_path / "a.webp", set())) == GREEN).all()
    assert "cannot be read" in caplog.messages[0]


def test_srgb_is_left_alone_without_a_word(tmp_path, caplog):
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    Image.new("RGB", (64, 64), GREEN).save(tmp_path / "a.png", icc_profile=srgb)
    assert (np.asarray(read_image(tmp_path / "a.png", set())) == GREEN).all()
    assert not caplog.messages


def test_pictures_of_pillow_in_a_list_have_their_profiles(tmp_path):
    picture = Image.new("RGB", (42, 42), in_space(GREEN, "Display P3"))
    picture.info["icc_profile"] = stored("Display P3")
    clip = load_clip([picture, picture], size=42)
    assert np.abs(255 * np.asarray(clip.images)[0] - GREEN).max() <= 4


def test_a_profile_does_not_hide_what_is_wrong_with_a_file(tmp_path):
    Image.new("RGB", (64, 64), GREEN).save(tmp_path / "a.png", icc_profile=stored("Display P3"))
    (tmp_path / "a.png").write_bytes((tmp_path / "a.png").read_bytes()[:-60])
    with pytest.raises(ClipError, match="cannot read image"):
        read_image(tmp_path / "a.png")

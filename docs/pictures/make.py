"""Make the pictures of the README and the site from the demo: `make pictures`."""

import sys
from pathlib import Path

from PIL import Image

from vggtjax import Reconstruction
from vggtjax.results.films import film_frames, write_film

PICTURES = Path(__file__).parent
WIDTH = 1280  # of the sheets


def main(folder: Path) -> None:
    """Write turntable.gif, sheet.png and truth.png of the demo's result."""
    result = Reconstruction.load(folder)
    write_film(PICTURES / "turntable.gif", film_frames(result, seconds=5, fps=10, size=(480, 270)), 10)
    for name in ("sheet.png", "truth.png"):
        with Image.open(folder / "preview" / name) as picture:
            picture.thumbnail((WIDTH, WIDTH), Image.Resampling.LANCZOS)
            picture.save(PICTURES / name, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))

"""Make the pictures of the README and of the pages from the embedded model: `make pictures`."""

import sys
from pathlib import Path

import concepts
from PIL import Image

from vggtjax import Reconstruction
from vggtjax.results.films import film_frames, write_film

PICTURES = Path(__file__).parent
WIDTH = 1280  # of the sheets


def main(folder: Path) -> None:
    """Write room.webp, sheet.webp and truth.webp of the demo's result, and the pictures of the concepts."""
    result = Reconstruction.load(folder)
    write_film(PICTURES / "room.webp", film_frames(result, seconds=4, fps=8, size=(400, 225)), 8)
    for name in ("sheet", "truth"):
        with Image.open(folder / "preview" / f"{name}.png") as picture:
            picture.thumbnail((WIDTH, WIDTH), Image.Resampling.LANCZOS)
            picture.save(PICTURES / f"{name}.webp", quality=88)
    concepts.make()


if __name__ == "__main__":
    main(Path(sys.argv[1]))

"""The configuration of generated scenes: size, frames, objects, camera motion and rendering."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from vggtjax.errors import InputError
from vggtjax.storage.json_values import Share, check_fields

Split = Literal["training", "test"]  # of textures
Side = Annotated[int, Meta(ge=8, le=2048)]  # pixels
Objects = Annotated[int, Meta(ge=1, le=64)]
Travel = Annotated[float, Meta(ge=0, le=2)]
Degrees = Annotated[float, Meta(ge=10, le=150)]
Tilt = Annotated[float, Meta(ge=-60, le=60)]  # degrees
Roll = Annotated[float, Meta(ge=0, le=180)]  # degrees
BODY = (("box", 1), ("ellipsoid", 1), ("cylinder", 4))  # parts of the articulated figure: torso, head, four limbs


@dataclass(frozen=True)
class SceneConfig:
    """Content and rendering of generated clips. Static under jit.

    Attributes:
        height, width: of the images, in pixels.
        frames: at equal steps of the clip's time from 0 to 1.
        dynamic: share of clips in which one to three objects move; False and True are 0 and 1.
        boxes, ellipsoids, cylinders: most objects of a scene besides the articulated figure; each is present or absent.
        motion: range of the camera's share of its largest path, in [0, 2].
        static_camera: share of clips whose camera stands still.
        pitch: range of the angle by which the camera looks below the point of interest, in degrees.
        roll: largest roll in either direction, in degrees, besides that of a hand-held camera.
        field_of_view: range of the horizontal field of view, in degrees.
        samples: rays per pixel along each side, averaged in the image; truth is that of the pixel's centre.
        shutter: share of the time between frames that the shutter is open (motion blur), in `exposures` steps.
        noise: largest standard deviation of the sensor's noise.
        flicker: standard deviation of the logarithm of the exposure from frame to frame.
        frozen: moving objects keep their place of the middle of the clip; masks still show them.
    """

    height: Side = 64
    width: Side = 64
    frames: Annotated[int, Meta(ge=1, le=1000)] = 4
    dynamic: Share | bool = 0.0
    boxes: Objects = 5
    ellipsoids: Objects = 2
    cylinders: Objects = 2
    motion: tuple[Travel, Travel] = (0.1, 1.0)
    static_camera: Share = 0.05
    pitch: tuple[Tilt, Tilt] = (0.0, 0.0)
    roll: Roll = 0.0
    field_of_view: tuple[Degrees, Degrees] = (45.0, 75.0)
    samples: Annotated[int, Meta(ge=1, le=8)] = 1
    shutter: Share = 0.0
    exposures: Annotated[int, Meta(ge=1, le=64)] = 1
    noise: Share = 0.02
    flicker: Share = 0.08
    frozen: bool = False

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("motion", "pitch", "field_of_view"):
            low, high = getattr(self, name)
            if low > high:
                raise InputError(f"{name} is {(low, high)}; expected two numbers, the smaller first")

    @property
    def kinds(self) -> tuple[str, ...]:
        """Shape of every part: the articulated figure's first in each kind."""
        counts = zip(BODY, (self.boxes, self.ellipsoids, self.cylinders), strict=True)
        return tuple(kind for (kind, parts), count in counts for _ in range(parts + count))

    @property
    def objects(self) -> tuple[int, ...]:
        """Object of every part, from 0; object 0 is the articulated figure."""
        result, following = [], 1
        for kind, parts in BODY:
            alone = self.kinds.count(kind) - parts
            result += [0] * parts + list(range(following, following + alone))
            following += alone
        return tuple(result)

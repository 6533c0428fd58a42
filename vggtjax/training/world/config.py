"""The rows of generated worlds: how often each kind of place, camera, mover and flaw of the picture is drawn."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated

from msgspec import Meta

from vggtjax.errors import InputError
from vggtjax.storage.json_values import NotNegative, Share, check_fields

Degrees = Annotated[float, Meta(ge=10, le=150)]
Seconds = Annotated[float, Meta(ge=0.1, le=6)]  # paths have 65 points: enough for a hand that shakes at 5 Hz


@dataclass(frozen=True)
class Places:
    """How often each kind of place is drawn, relative to the others."""

    room: NotNegative = 0.5
    street: NotNegative = 0.3
    landscape: NotNegative = 0.2


@dataclass(frozen=True)
class Cameras:
    """How often the camera walks, circles its subject, turns on the spot, follows what moves, or is held still."""

    walk: NotNegative = 0.4
    orbit: NotNegative = 0.25
    turn: NotNegative = 0.15
    follow: NotNegative = 0.12
    still: NotNegative = 0.08


@dataclass(frozen=True)
class Movers:
    """How often people and animals, vehicles, rigid things, and pieces of photographs are what moves."""

    walker: NotNegative = 0.5
    vehicle: NotNegative = 0.2
    thing: NotNegative = 0.2
    cutout: NotNegative = 0.1


@dataclass(frozen=True)
class WorldConfig:
    """What is drawn, in what shares. Rows of a recipe; one is left out by its weight or share of 0.

    Attributes:
        places, cameras, movers: weights of the kinds.
        dynamic: share of clips in which one to four things move.
        tabletop: share of the cameras in rooms with tables that film the top of one, of those that film no mover; and
            of the rigid movers there that move over one.
        clutter: factor of the number of things at rest, in [0, 4].
        seconds: range of the length of a clip; frames are at equal steps.
        motion: factor of what the camera travels and turns, in [0, 4].
        shake: factor of what the hand adds, in [0, 4].
        field_of_view: range of the field of view along the longer side, in degrees.
        blur: share of clips with motion blur.
        rolling: share of clips with a rolling shutter; truth is that of the middle row.
        compression: share of clips with blocks of JPEG.
        noise: largest standard deviation of the sensor's noise.
        vignette: largest loss of brightness in the corners.
        flicker: size of the waves of the logarithm of the exposure.
    """

    places: Places = Places()
    cameras: Cameras = Cameras()
    movers: Movers = Movers()
    dynamic: Share = 0.5
    tabletop: Share = 0.4
    clutter: Annotated[float, Meta(ge=0, le=4)] = 1.0
    seconds: tuple[Seconds, Seconds] = (0.6, 6.0)
    motion: Annotated[float, Meta(ge=0, le=4)] = 1.0
    shake: Annotated[float, Meta(ge=0, le=4)] = 1.0
    field_of_view: tuple[Degrees, Degrees] = (42.0, 82.0)
    blur: Share = 0.3
    rolling: Share = 0.3
    compression: Share = 0.7
    noise: Share = 0.02
    vignette: Share = 0.3
    flicker: Share = 0.08

    def __post_init__(self) -> None:
        check_fields(self, "world")
        for name in ("places", "cameras", "movers"):
            check_fields(getattr(self, name), f"world.{name}")
            if not sum(asdict(getattr(self, name)).values()) > 0:
                raise InputError(f"world.{name} has weights of 0 alone; expected at least one above 0")
        for name in ("seconds", "field_of_view"):
            low, high = getattr(self, name)
            if low > high:
                raise InputError(f"world.{name} is {(low, high)}; expected two numbers, the smaller first")

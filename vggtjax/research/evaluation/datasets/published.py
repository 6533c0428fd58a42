"""The sequences of published protocols. Does not import jax.

From the evaluation code of MonST3R, which CUT3R and Easi3R follow (Sintel, TUM dynamics, Bonn, KITTI), the validation
lists of DAVIS (ImageSets/480p/val.txt of 2016, ImageSets/2017/val.txt), and of the release of DyCheck's
sequences with Shape of Motion.
"""

from __future__ import annotations


def _names(text: str) -> tuple[str, ...]:
    return tuple(text.split())


DAVIS_2016 = _names(
    "blackswan bmx-trees breakdance camel car-roundabout car-shadow cows dance-twirl dog drift-chicane drift-straight "
    "goat horsejump-high kite-surf libby motocross-jump paragliding-launch parkour scooter-black soapbox"
)
DAVIS_2017 = _names(
    "bike-packing blackswan bmx-trees breakdance camel car-roundabout car-shadow cows dance-twirl dog dogs-jump "
    "drift-chicane drift-straight goat gold-fish horsejump-high india judo kite-surf lab-coat libby loading "
    "mbike-trick motocross-jump paragliding-launch parkour pigs scooter-black shooting soapbox"
)
SINTEL = _names(
    "alley_2 ambush_4 ambush_5 ambush_6 cave_2 cave_4 market_2 market_5 market_6 shaman_3 sleeping_1 sleeping_2 "
    "temple_2 temple_3"
)
TUM = _names(
    "freiburg3_sitting_static freiburg3_sitting_xyz freiburg3_sitting_halfsphere freiburg3_sitting_rpy "
    "freiburg3_walking_static freiburg3_walking_xyz freiburg3_walking_halfsphere freiburg3_walking_rpy"
)
BONN = _names("balloon2 crowd2 crowd3 person_tracking2 synchronous")
KITTI = _names(
    "2011_09_26_drive_0002_sync 2011_09_26_drive_0005_sync 2011_09_26_drive_0013_sync 2011_09_26_drive_0020_sync "
    "2011_09_26_drive_0023_sync 2011_09_26_drive_0036_sync 2011_09_26_drive_0079_sync 2011_09_26_drive_0095_sync "
    "2011_09_26_drive_0113_sync 2011_09_28_drive_0037_sync 2011_09_29_drive_0026_sync 2011_09_30_drive_0016_sync "
    "2011_10_03_drive_0047_sync"
)
DYCHECK = _names(
    "apple backpack block creeper handwavy haru-sit mochi-high-five paper-windmill pillow spin sriracha-tree teddy"
)

"""The table of readers: every place where a file or a folder of a stranger enters the library.

What a reader gives is used as the commands use it: frames are decoded, depth and masks of the first frame are read,
mapped tensors are touched.
"""

from tests.fuzz.rows import known, media, own_files, runs, sets, weights

READERS = (
    *weights.ROWS,  # and what goes with them: configurations, recipes, training
    *own_files.ROWS,  # arrays, results, kept parts of runs
    *runs.ROWS,  # what a run goes on from
    *media.ROWS,  # pictures, videos, masks
    *known.ROWS,  # lists of clips, points, depths, cameras
    *sets.ROWS,  # captures, data sets, results of other programs
)

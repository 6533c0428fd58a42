"""The table of readers: every place where a file or a folder of a stranger enters the library.

What a reader gives is used as the commands use it: frames are decoded, depth and masks of the first frame are read,
mapped tensors are touched.
"""

from tests.fuzz.rows import foreign, own_files, weights

READERS = (*weights.ROWS, *own_files.ROWS, *foreign.ROWS)

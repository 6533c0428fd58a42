"""Depth files of other programs that are not whole."""

import struct

import numpy as np
import pytest

from tests.dataset_files import npy, write
from vggtjax.captures.depth_files import read_npy
from vggtjax.errors import InputError


@pytest.mark.parametrize(
    "content",
    [
        b"\x93NUMPY",
        npy(np.ones((3, 4), np.float32))[:-1],
        npy(np.ones((3, 4, 2), np.float32)),
        npy(np.ones(12, np.float32)),
        npy(np.ones((3, 4), bool)),
        npy(np.ones((3, 4), np.float32)).replace(b"(3, 4)", b"(9999999999, 4)"),
        b"\x93NUMPY\x01\x00"
        + struct.pack("<H", 59)
        + b"{'descr': '|O', 'fortran_order': False, 'shape': (1,), }  \n"
        + b"\x80\x04.",
    ],
)
def test_arrays_that_are_no_depth_are_refused(tmp_path, content):
    with pytest.raises(InputError, match=r"a\.npy"):
        read_npy(write(tmp_path / "a.npy", content))

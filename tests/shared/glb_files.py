"""GLB files, read by hand."""

import json

import numpy as np


def split_glb(data):
    """Return the tree of a GLB file, and a function from the number of an accessor of floats to its values."""
    length = int.from_bytes(data[12:16], "little")
    tree, body = json.loads(data[20 : 20 + length]), data[28 + length :]

    def values(number):
        accessor = tree["accessors"][number]
        start = tree["bufferViews"][accessor["bufferView"]].get("byteOffset", 0)
        columns = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        return np.frombuffer(body, np.float32, accessor["count"] * columns, start).reshape(-1, columns)

    return tree, values

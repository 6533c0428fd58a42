"""The way from `reconstruct` to the softmax is the table of the page that shows it."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np

import vggtjax
from tests.shared.tiny import tiny_model
from vggtjax.network.kernels import attention
from vggtjax.pipeline.run import reconstruct

PACKAGE = Path(vggtjax.__file__).parent
PAGE = PACKAGE.parent / "docs/concepts/flow.md"
MOST = 10  # functions, of which a reader keeps track


def test_the_way_to_the_softmax_is_the_listed_one(monkeypatch):
    stacks = []

    def spied(*arrays):
        frame, functions = sys._getframe(1), []
        while frame is not None:
            file = Path(frame.f_code.co_filename)
            if file.is_relative_to(PACKAGE):
                functions.append((file.relative_to(PACKAGE).as_posix(), frame.f_code.co_qualname))
            frame = frame.f_back
        stacks.append(functions[::-1])
        return attended(*arrays)

    attended = attention.attention_in_chunks
    monkeypatch.setattr(attention, "attention_in_chunks", spied)
    model = tiny_model()
    side = 3 * model.config.patch_size
    reconstruct(model, np.zeros((3, side, side, 3), np.uint8), size=side)

    listed = re.findall(r"^\| \d+ \| `(\S+)` \| `(\S+)` \|", PAGE.read_text(), re.MULTILINE)
    aggregated = [stack for stack in stacks if ("network/aggregator.py", "Pair.__call__") in stack]
    for stack in (aggregated[0], aggregated[-1]):  # of the frame block, of the global block
        assert [function for function in stack if function[0] != "pipeline/steps.py"] == listed
    assert len(listed) <= MOST

"""A process that reconstructs the walk in windows with the truth for a network, and kills itself: SIGKILL, no clean-up.

python -m tests.pipeline.windows.killed OUT TRUTH STAGE DONE: at the stage's step DONE. TRUTH is an .npz of the walk.
"""

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from tests.pipeline.windows import walk as walks
from vggtjax.clips.truth import Truth
from vggtjax.pipeline.windows.run import run_windows
from vggtjax.progress import Progress


def main(out: str, truth: str, stage: str, done: str) -> None:
    with np.load(truth) as arrays:
        walk = Truth(**arrays)
    walks.walk = lambda: walk  # rendering it anew would take seconds

    @contextmanager
    def kill_at(name: str) -> Iterator[Progress]:
        def progress(step: int, total: int | None) -> None:
            if (name, step) == (stage, int(done)):
                os.kill(os.getpid(), signal.SIGKILL)

        yield progress

    moving = walks.movers()
    plan = walks.plan_of()._replace(on_stage=kill_at)
    tools = walks.tools_of(lambda clip: walks.window_result(clip, 0, moving, 0.03))
    run_windows(np.asarray(walk.images), Path(out), walks.windows_of(loops=True), plan, tools, walks.SETTINGS)


if __name__ == "__main__":
    main(*sys.argv[1:])

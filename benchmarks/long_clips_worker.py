"""A process that reconstructs a long clip in windows and says how much memory it took.

python -m benchmarks.long_clips_worker FOLDER MODEL FRAMES WINDOW OVERLAP; prints a line of JSON.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.worker import PeakMemory


def main(folder: str, model: str, frames: str, window: str, overlap: str) -> None:
    """Reconstruct the first frames of a folder."""
    from vggtjax.clips.preprocessing import Fitter
    from vggtjax.clips.sampling import Sampling
    from vggtjax.commands.process import keep_freed_memory
    from vggtjax.pretrained.load import load_model
    from vggtjax.windows.plan import Windows
    from vggtjax.windows.run import LongRun, reconstruct_long

    keep_freed_memory()
    loaded = load_model(model)
    fitter = Fitter(size=loaded.config.image_size, patch=loaded.config.patch_size)
    windows = Windows(int(window), int(overlap))
    plan = LongRun(windows, sampling=Sampling(max_frames=int(frames)), fitter=fitter)
    began = time.perf_counter()
    with PeakMemory() as peak, TemporaryDirectory() as out:
        reconstruct_long(loaded, folder, Path(out), windows, long_run=plan)
    answer = {"own": peak.own, "total": peak.total, "seconds": time.perf_counter() - began}
    sys.stdout.write(json.dumps(answer) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])

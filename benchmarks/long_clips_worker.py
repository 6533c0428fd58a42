"""A process that reconstructs a long clip, in windows or all frames together, and says what memory and time it took.

python -m benchmarks.long_clips_worker FOLDER MODEL FRAMES WINDOW OVERLAP; prints a line of JSON. WINDOW 0 runs all
frames together.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.worker import PeakMemory


def main(folder: str, model: str, frames: str, window: str, overlap: str) -> None:
    """Reconstruct the first frames of a folder, and write the result."""
    from vggtjax.clips.clip import load_clip
    from vggtjax.clips.preprocessing import Fitter
    from vggtjax.clips.sampling import Sampling
    from vggtjax.pipeline.run import reconstruct
    from vggtjax.pretrained.load import load_model
    from vggtjax.storage.kept_memory import keep_freed_memory
    from vggtjax.windows.plan import Windows
    from vggtjax.windows.run import LongRun, reconstruct_long

    keep_freed_memory()
    loaded = load_model(model)
    fitter = Fitter(size=loaded.config.image_size, patch=loaded.config.patch_size)
    began, processor = time.perf_counter(), time.process_time()
    with PeakMemory() as peak, TemporaryDirectory() as out:
        if int(window):
            windows = Windows(int(window), int(overlap))
            plan = LongRun(windows, sampling=Sampling(max_frames=int(frames)), fitter=fitter)
            reconstruct_long(loaded, folder, Path(out), windows, long_run=plan)
        else:
            clip = load_clip(folder, size=fitter.size, patch=fitter.patch, max_frames=int(frames))
            reconstruct(loaded, clip).save(out)
    answer = {"own": peak.own, "total": peak.total}
    answer |= {"seconds": time.perf_counter() - began, "processor": time.process_time() - processor}
    sys.stdout.write(json.dumps(answer) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])

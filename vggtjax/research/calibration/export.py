"""Write a calibration, of cues and perhaps of the second pass, as files.

In the folder:

    model.safetensors       the model with the chosen cues and second pass in its configuration, for load_model
    sweep.png               the quality of each pair's maps; chosen maps are outlined
    calibration.json        the numbers: sweep, choice, second pass, clips; written last, after the other files
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from PIL import Image

from vggtjax.network.checkpoint import Model, save_model
from vggtjax.research.calibration.choice import Choice, Rating, Step, halves
from vggtjax.research.calibration.heatmap import draw_sweep
from vggtjax.research.calibration.second_pass import SecondPassChoice, Setting
from vggtjax.research.calibration.sweep import DYNAMIC, GRAMS, KINDS, STATIC, UNCLEAR, Sweep
from vggtjax.storage.writing import check_free, says_format, staging

FORMAT = "vggtjax calibration"
VERSION = 1
NUMBERS, MODEL, PICTURE = "calibration.json", "model.safetensors", "sweep.png"


def calibrated(model: Model, choice: Choice, second: Setting | None = None) -> Model:
    """Return the model with the chosen cues, and with a setting of its second pass if one was chosen.

    With cosines, Otsu's threshold is the methods' own, and None is written: it leaves vggt4d, too, its own.
    """
    motion = choice.motion
    if second is not None:
        threshold = None if choice.gram == "cosine" and second.threshold == "otsu" else second.threshold
        motion = dataclasses.replace(motion, mask_pairs=second.pairs, threshold=threshold)
    return dataclasses.replace(model, config=dataclasses.replace(model.config, motion=motion))


def save_calibration(
    folder: str | Path,
    model: Model,
    sweep: Sweep,
    choice: Choice,
    *,
    second: SecondPassChoice | None = None,
    source: Mapping[str, Any] | None = None,
) -> Path:
    """Write the calibrated model, the numbers and the picture; return the model's path.

    The folder is made if missing; an earlier calibration in it is replaced. `second` is what `choose_second_pass`
    returned; without it the model keeps its number of pairs and its threshold. `source` are JSON values about the
    clips. Raises OutputError if the folder cannot be written, or holds files with these names of another origin.
    """
    folder = Path(folder)
    check_folder(folder)
    auc = sweep.auc()
    config = calibrated(model, choice, None if second is None else second.best).config
    choice = choice._replace(motion=config.motion)
    numbers = calibration_numbers(model, sweep, choice, auc) | {"source": dict(source or {})}
    if second is not None:
        numbers["second_pass"] = {
            "recommended": second.best._asdict(),
            "scenes": second.scenes,
            "first_pass": second.first._asdict(),
            "errors": [setting._asdict() | error._asdict() for setting, error in second.errors.items()],
        }
    with staging(folder) as staged:
        names = {"name": model.name or None, "note": model.note}
        save_model(staged / MODEL, model.params, config, **names, untrained_heads=model.untrained_heads)
        Image.fromarray(draw_sweep(auc, choice, title=model.name)).save(staged / PICTURE)
        (staged / NUMBERS).write_text(json.dumps(numbers, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        (folder / NUMBERS).unlink(missing_ok=True)
        for name in (MODEL, PICTURE, NUMBERS):
            (staged / name).replace(folder / name)
    return folder / MODEL


def check_folder(folder: Path) -> None:
    """Check before the work that a calibration can be saved in `folder`; OutputError as `save_calibration`."""
    replaced = says_format(folder / NUMBERS, FORMAT)
    check_free(folder, (NUMBERS, MODEL, PICTURE), replaced=replaced, what="calibration")


def calibration_numbers(
    model: Model, sweep: Sweep, choice: Choice, auc: Float64[np.ndarray, "G C L"]
) -> dict[str, Any]:
    """Return the content of calibration.json: plain values, areas under the ROC curve in [0, 1]."""
    calibration, held_out = halves(sweep)
    return {
        "format": FORMAT,
        "version": VERSION,
        "model": model.summary(),
        "clips": {
            "shape": {"frames": sweep.truth.shape[1], "patches": sweep.truth.shape[2]},
            "calibration": _counts(calibration),
            "held_out": _counts(held_out),
        },
        "choice": {
            "gram": choice.gram,
            "motion": dataclasses.asdict(choice.motion),
            "steps": [_step(step) for step in choice.steps],
            "refused": None if choice.refused is None else _step(choice.refused),
        },
        "matches_that_come_back": sweep.came_back.mean(axis=1, dtype=float).round(6).tolist(),  # of every pair
        "default_table": {"motion": dataclasses.asdict(sweep.table), "auc": _rating(choice.table)},
        "sweep": [
            {"gram": gram, "rows": kind.rows, "columns": kind.columns, "statistic": kind.statistic}
            | {"auc_of_layers": auc[g, c].round(6).tolist()}  # on all clips
            for g, gram in enumerate(GRAMS)
            for c, kind in enumerate(KINDS)
        ],
    }


def _step(step: Step) -> dict[str, Any]:
    return {"cue": dataclasses.asdict(step.cue), "auc": _rating(step.rating)}


def _rating(rating: Rating) -> dict[str, float]:
    return {name: round(value, 6) for name, value in rating._asdict().items()}


def _counts(half: Sweep) -> dict[str, int]:
    kinds = {"dynamic_tokens": DYNAMIC, "static_tokens": STATIC, "ignored_tokens": UNCLEAR}
    return {"clips": len(half.truth)} | {name: int((half.truth == value).sum()) for name, value in kinds.items()}

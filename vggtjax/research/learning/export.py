"""Writing fits.

In the folder:

    fusion.safetensors      tree of the chosen family, fitted to all clips but those for early stopping; for --fusion
    families/               such a file for every family
    fit.json                all numbers: scores, fits, settings; written last, when all other files are whole
    table.md                means over the seeds
    *.png                   scores, precision against confidence, calibration, losses
    states/                 states of the fits, from which an interrupted run resumes
"""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from vggtjax.method.fusion.family import paper_rule, parse_family
from vggtjax.method.fusion.file import save_fusion
from vggtjax.research.learning.ablation import PAPER, RuleScore, fit_split, gains, markdown, split_clips, table
from vggtjax.research.learning.clip_passes import ClipPasses, observations
from vggtjax.research.learning.fit import FitConfig
from vggtjax.research.learning.plots import draw_fits
from vggtjax.storage.writing import check_free, says_format, staging, writing

FORMAT = "vggtjax fits"
VERSION = 1
NUMBERS, FUSION, TABLE, FAMILIES, STATES = "fit.json", "fusion.safetensors", "table.md", "families", "states"
PICTURES = ("scores.png", "precision.png", "calibration.png", "losses.png")
_MARK = "fits.json"  # marks the folder of states as written by this library


def check_folder(folder: Path) -> None:
    """Raise OutputError where fits cannot be saved: the folder cannot be written, or holds other files of our names."""
    is_ours = says_format(folder / STATES / _MARK, FORMAT) or says_format(folder / NUMBERS, FORMAT)
    check_free(folder, (NUMBERS, FUSION, TABLE, FAMILIES, *PICTURES), replaced=is_ours, what="fit")


def save_fits(
    folder: Path,
    scores: Sequence[RuleScore],
    clips: Mapping[str, ClipPasses],
    config: FitConfig,
    *,
    about: Mapping[str, Any],
) -> str:
    """Write all files, and return the name of the chosen family: the lowest mean NLL on the clips for early stopping.

    Every family is fitted again to all clips but those for early stopping, so the scores are of other trees than the
    files. Where no family was fitted, the paper's rule is written.
    """
    families = list(dict.fromkeys(score.rule for score in scores if score.fit is not None))
    stopping = {name: float(np.mean([o.stopping["nll"] for o in scores if o.rule == name])) for name in families}
    chosen = min(stopping, key=stopping.__getitem__) if families else PAPER
    facts = dict(about) | {"clips": list(clips), "objective": config.objective}
    split = split_clips(len(clips), 0, float(about["held_out"]))
    split = split._replace(fitted=sorted([*split.fitted, *split.test]))
    all_clips = list(clips.values())
    seen = [observations(clip) for clip in all_clips]
    trees = {PAPER: paper_rule()}
    for name in families:
        whole = dataclasses.replace(config, family=parse_family(name))
        fit = fit_split(all_clips, seen, split, whole, pixels=int(about["pixels"]), folder=folder / STATES)
        trees[name] = fit.params
    numbers = {
        "format": FORMAT,
        "version": VERSION,
        "chosen": chosen,
        "about": facts,
        "config": dataclasses.asdict(config),
        "nll_for_stopping": stopping,
        "table": table(scores),
        "against_the_paper": gains(scores),
        "outcomes": [_plain(score) for score in scores],
        "fitted_to_all": {name: _values(tree) for name, tree in trees.items()},
    }
    with staging(folder) as staged:
        for name, tree in trees.items():
            save_fusion(staged / FAMILIES / f"{name.replace('+', '_')}.safetensors", tree, facts | {"family": name})
        save_fusion(staged / FUSION, trees[chosen], facts | {"family": chosen})
        (staged / TABLE).write_text(markdown(table(scores)), encoding="utf-8")
        draw_fits(staged, scores, all_clips, chosen)
        (staged / NUMBERS).write_text(json.dumps(numbers, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        (folder / NUMBERS).unlink(missing_ok=True)
        shutil.rmtree(folder / FAMILIES, ignore_errors=True)
        for name in (FAMILIES, FUSION, TABLE, *PICTURES, NUMBERS):
            (staged / name).replace(folder / name)
    return chosen


def _plain(score: RuleScore) -> dict[str, Any]:
    fit = score.fit and {
        "params": _values(score.fit.params),
        "objective_for_stopping": score.fit.held_out_loss,
        "losses": score.fit.losses.tolist(),
        "stopped_early": score.fit.stopped_early,
    }
    names = ("rule", "seed", "metrics", "stopping")
    plain = {name: getattr(score, name) for name in names}
    return plain | {"reliability": score.reliability.tolist(), "fit": fit}


def _values(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Return a tree's numbers, or the number of values of a gate."""
    values: dict[str, Any] = {name: np.asarray(leaf).tolist() for name, leaf in tree.items() if name != "gate"}
    if "gate" in tree:
        values["gate"] = {"values": sum(np.size(x) for x in jax.tree.leaves(tree["gate"]))}
    return values


def begin(folder: Path) -> Path:
    """Return the folder for the states of fits, made now and marked."""
    with writing(folder / STATES / _MARK) as path:
        path.write_text(json.dumps({"format": FORMAT}) + "\n", encoding="utf-8")
    return folder / STATES

"""Writing what was fitted.

In the folder:

    fusion.safetensors      the chosen family's tree, fitted to all clips but those for stopping; --fusion takes it
    families/               one such file for every family
    fit.json                every number: scores, fits, settings; written last, so its presence says that all is whole
    table.md                means over the seeds
    *.png                   scores, precision against confidence, calibration, losses
    states/                 states of the fits, for an interrupted run to go on
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from vggtjax.files import check_free, staging, writing
from vggtjax.learning.ablation import PAPER, Outcome, Split, fit_split, gains, markdown, split_clips, table
from vggtjax.learning.clip_passes import ClipPasses
from vggtjax.learning.family import identity, parse_family
from vggtjax.learning.fit import FitConfig
from vggtjax.learning.fusion_file import save_fusion
from vggtjax.learning.plots import draw_fits

FORMAT = "vggtjax fits"
VERSION = 1
NUMBERS, FUSION, TABLE, FAMILIES, STATES = "fit.json", "fusion.safetensors", "table.md", "families", "states"
PICTURES = ("scores.png", "precision.png", "calibration.png", "losses.png")
_MOST_BYTES = 2**24


def check_folder(folder: Path) -> None:
    """Make sure that fits can be saved in `folder`; OutputError where it cannot be written or holds files of others."""
    check_free(folder, (NUMBERS, FUSION, TABLE, FAMILIES, *PICTURES), replaced=_is_ours(folder), what="fit")


def save_fits(
    folder: Path,
    outcomes: Sequence[Outcome],
    clips: Mapping[str, ClipPasses],
    patch_size: int,
    config: FitConfig,
    *,
    about: Mapping[str, Any],
) -> str:
    """Write everything, and return the name of the chosen family: the lowest objective on the clips for stopping.

    Every family is fitted once more to all clips but a part for stopping, which the scores then do not hold for; where
    no family was fitted, the paper's rule is written.
    """
    families = list(dict.fromkeys(outcome.rule for outcome in outcomes if outcome.fit is not None))
    objectives = {
        name: float(np.mean([o.fit.held_out_loss for o in outcomes if o.rule == name and o.fit is not None]))
        for name in families
    }
    chosen = min(objectives, key=objectives.__getitem__) if families else PAPER
    facts = dict(about) | {"clips": list(clips), "objective": config.objective}
    split = _final_split(len(clips), float(about["held_out"]))
    trees = {PAPER: identity()}
    for name in families:
        whole = dataclasses.replace(config, family=parse_family(name))
        pixels = int(about["pixels"])
        fit = fit_split(list(clips.values()), patch_size, split, whole, pixels=pixels, folder=folder / STATES)
        trees[name] = fit.params
    numbers = {
        "format": FORMAT,
        "version": VERSION,
        "chosen": chosen,
        "about": facts,
        "config": dataclasses.asdict(config),
        "objective_for_stopping": objectives,
        "table": table(outcomes),
        "against_the_paper": gains(outcomes),
        "outcomes": [_plain(outcome) for outcome in outcomes],
        "fitted_to_all": {name: _values(tree) for name, tree in trees.items()},
    }
    with staging(folder) as staged:
        (folder / NUMBERS).unlink(missing_ok=True)
        for name, tree in trees.items():
            said = facts | {"family": name}
            (folder / FAMILIES).mkdir(exist_ok=True)
            save_fusion(folder / FAMILIES / f"{name.replace('+', '_')}.safetensors", tree, said)
        save_fusion(folder / FUSION, trees[chosen], facts | {"family": chosen})
        (staged / TABLE).write_text(markdown(table(outcomes)), encoding="utf-8")
        draw_fits(staged, outcomes, list(clips.values()), patch_size, chosen)
        for name in (TABLE, *PICTURES):
            (staged / name).replace(folder / name)
    with writing(folder / NUMBERS) as path:
        path.write_text(json.dumps(numbers, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return chosen


def _final_split(count: int, held_out: float) -> Split:
    """Return a split in which what is kept for the scores elsewhere is fitted to as well."""
    split = split_clips(count, 0, held_out)
    return Split(sorted([*split.fitted, *split.test]), split.validation, split.test)


def _plain(outcome: Outcome) -> dict[str, Any]:
    fit = outcome.fit
    return {
        "rule": outcome.rule,
        "seed": outcome.seed,
        "metrics": outcome.metrics,
        "reliability": outcome.reliability.tolist(),
        "fit": fit
        and {
            "params": _values(fit.params),
            "objective_for_stopping": fit.held_out_loss,
            "losses": [[float(x) for x in row] for row in fit.losses],
            "stopped_early": fit.stopped_early,
        },
    }


def _values(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Return a tree's numbers; of a gate, how many it has."""
    return {
        name: {"values": sum(np.size(x) for x in jax.tree.leaves(leaf))}
        if name == "gate"
        else np.asarray(leaf).tolist()
        for name, leaf in tree.items()
    }


def _is_ours(folder: Path) -> bool:
    if (folder / STATES).is_dir() and not (folder / NUMBERS).exists():
        return not (folder / FUSION).exists() or (folder / FAMILIES).is_dir()  # an interrupted run's
    try:
        if (folder / NUMBERS).stat().st_size > _MOST_BYTES:
            return False
        numbers = json.loads((folder / NUMBERS).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(numbers, dict) and numbers.get("format") == FORMAT

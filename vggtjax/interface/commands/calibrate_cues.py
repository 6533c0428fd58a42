"""The command `vggtjax calibrate-cues`. Does not import jax before it is needed."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from vggtjax.config import Gram
from vggtjax.errors import InputError, share, whole_number
from vggtjax.interface.commands.flags import InWords
from vggtjax.interface.commands.report import Report
from vggtjax.options import pairs_to_try
from vggtjax.storage.writing import check_file

if TYPE_CHECKING:
    import numpy as np

    from vggtjax.clips.truth import Truth
    from vggtjax.research.calibration.choice import Choice
    from vggtjax.research.calibration.second_pass import SecondPassChoice
    from vggtjax.training.scenes import SyntheticClip

_Pairs = Annotated[tuple[int, ...] | None, tyro.conf.arg(help_behavior_hint="", metavar="INT [INT ...]")]
_KEYS = 0x63756573  # folded into the seed's key, so that no other use of a seed draws these scenes


def calibrate_cues(
    model: Annotated[str, tyro.conf.arg(metavar="MODEL")],
    out: Path,
    *,
    scenes: int = 64,
    frames: int = 12,
    size: InWords[int | None] = None,
    gram: Gram = "cosine",
    max_terms: int = 5,
    floor: float = 0.0,
    mask_pairs: _Pairs = None,
    assets: InWords[Path | None] = None,
    seed: int = 0,
) -> None:
    """Choose a model's motion cues and the pairs of blocks that match frames, and save the model with them.

    With --mask-pairs, also choose the threshold of the masks, and in how many pairs of blocks the second pass ignores
    keys.

    Args:
        model: a converted .safetensors, a PyTorch checkpoint, or a hub id such as facebook/VGGT-1B.
        out: folder for model.safetensors, sweep.png and calibration.json; an earlier calibration is replaced.
        scenes: number of scenes; every second one is held out.
        frames: of each scene.
        size: side of the images in pixels; the model's own by default.
        gram: similarity of the cues; with dot, --mask-pairs tries dropped keys instead of zeroed ones.
        max_terms: largest number of cues.
        floor: added to every map before the product, from 0 (as in the papers) to 1; the floor that the model
            stores is not used.
        mask_pairs: numbers of pairs to try on all of the scenes, with masks mined by both thresholds (otsu,
            multi-otsu). The number and the threshold with the lowest camera errors become what the model recommends;
            without this option the model keeps its own.
        assets: folder of textures, photographs and objects: clips are of rooms, streets and landscapes of these, 16:9,
            instead of rooms of simple shapes; none by default.
        seed: another seed draws other scenes.
    """
    if scenes < 2:
        raise InputError(f"scenes is {scenes}; expected at least 2, one to choose the cues and one to confirm them")
    whole_number("max_terms", max_terms, 1)
    if mask_pairs is not None:
        pairs_to_try(mask_pairs)
    floor = share("floor", floor)
    if not 0 <= seed < 2**31:
        raise InputError(f"seed is {seed}; expected a number in [0, 2**31)")
    report = Report()
    with report.running():
        import numpy as np

        from vggtjax.pipeline.pretrained.load import load_model
        from vggtjax.research.calibration.choice import choose
        from vggtjax.research.calibration.export import MODEL, calibrated, check_folder, save_calibration
        from vggtjax.research.calibration.second_pass import choose_second_pass
        from vggtjax.research.calibration.sweep import sweep

        check_folder(out)
        check_file(out / MODEL, overwrite=True, sources=[Path(model), Path(model) / MODEL])
        with report.stage("load model") as progress:
            loaded = load_model(model, progress=progress)
        side = loaded.config.clip_size if size is None else size
        if side < 1 or side % loaded.config.patch_size:
            raise InputError(f"size is {side}; expected a multiple of the patch size {loaded.config.patch_size}")
        numbers = None if mask_pairs is None else pairs_to_try(mask_pairs, loaded.config.depth)
        with report.stage("sweep") as progress:
            draw = partial(_clips, assets, scenes, frames, side, loaded.config.patch_size, seed)
            drawn = draw()
            clips = ((np.asarray(clip.images), np.asarray(clip.dynamic_mask)) for clip in drawn)
            swept = sweep(loaded.params, clips, loaded.config, progress=progress, total=scenes)
        with report.stage("choose") as progress:
            choice = choose(swept, gram=gram, max_terms=max_terms, floor=floor, progress=progress)
        second = None
        if numbers:
            with report.stage("try second passes") as progress:
                with_cues = calibrated(loaded, choice)
                second = choose_second_pass(with_cues, draw(), numbers, gram=gram, progress=progress, total=scenes)
        source = {
            "scenes": scenes,
            "frames": frames,
            "size": side,
            "textures": "training" if assets is None else "assets",
        }
        source |= {"key": f"fold_in(fold_in(key({seed}), {_KEYS}), scene)"}
        with report.stage("write"):
            path = save_calibration(out, loaded, swept, choice, second=second, source=source)
    _print(report, choice, swept.came_back.mean(axis=1), second, path)
    if loaded.note:
        report.line(loaded.warning)


def _print(report: Report, choice: Choice, came_back: np.ndarray, second: SecondPassChoice | None, path: Path) -> None:
    """Print the chosen cues, the pairs of blocks that match frames, and the second passes, with their ratings."""
    rows = {
        step.cue.name + (" (1 - m)" if step.cue.inverted else ""): "{:.3f}   {:.3f}".format(*step.rating)
        for step in choice.steps
    }
    report.line("AUC of the product up to each cue, on the calibration half and on the held-out half:")
    report.table(rows | {"default table": "{:.3f}   {:.3f}".format(*choice.table), "model": path})
    report.line(_matching_line(choice.motion.matching, came_back))
    if choice.steps[-1].rating.held_out < choice.table.held_out:
        report.line("On the held-out half the default table is better than the chosen table; try more scenes.")
    if second is not None:
        report.line(f"Cameras of the second pass with mined masks, on {second.scenes} scenes:")
        rows = {f"{pairs} pairs, {threshold}": errors for (pairs, threshold), errors in second.errors.items()}
        report.table(
            {
                name: f"rotation {errors.rotation:.2f} degrees, centres {errors.centres:.4f} median depths"
                for name, errors in ({"first pass": second.first} | rows).items()
            }
            | {"recommended": f"{second.best.pairs} pairs, {second.best.threshold}"}
        )


def _matching_line(pairs: tuple[int, ...] | None, shares: np.ndarray) -> str:
    """Return which pairs of blocks match frames, and how many of the others' matches come back."""
    if pairs is None:
        most = f"{shares.max():.0%} of the matches of a pair are cycle-consistent"
        return (
            f"No pair of blocks matches frames (at most {most}); the model stores none, and the pairs at 0.5 to 0.65 "
            "of its depth are used."
        )
    found = ", ".join(f"{pair} ({shares[pair]:.0%} of the matches are cycle-consistent)" for pair in pairs)
    others = [share for pair, share in enumerate(shares) if pair not in pairs]
    rest = f"; in the others at most {max(others):.0%}" if others else ""
    return f"Pairs of blocks that match frames: {found}{rest}."


def _clips(
    assets: Path | None, scenes: int, frames: int, size: int, patch: int, seed: int
) -> Iterator[SyntheticClip | Truth]:
    """Yield generated rooms, or worlds of a folder of assets, one at a time."""
    if assets is None:
        yield from generated_clips(scenes, frames, size, seed)
        return
    from vggtjax.training.world.truth import worlds_with_truth

    shape = {"frames": frames, "height": max(round(size * 9 / 16 / patch), 1) * patch, "width": size}
    yield from worlds_with_truth(assets, "dynamic", scenes, split="training", seed=seed, **shape)


def generated_clips(scenes: int, frames: int, size: int, seed: int) -> Iterator[SyntheticClip]:
    """Yield generated scenes with training textures, one at a time, as numpy arrays."""
    import jax

    from vggtjax.training.scenes import SceneConfig, generate, load_textures

    config = SceneConfig(height=size, width=size, frames=frames, dynamic=True)
    textures = load_textures("training")
    key = jax.random.fold_in(jax.random.key(seed), _KEYS)
    make = jax.jit(generate, static_argnames="config")
    for scene in range(scenes):
        yield jax.device_get(make(jax.random.fold_in(key, scene), textures, config))

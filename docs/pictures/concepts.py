"""The pictures of the concepts and the gallery, made from the embedded clip and generated scenes.

`make pictures` makes them when this file, the model, the clip or the version of vggtjax has changed; a test tells.
"""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from vggtjax import Reconstruction
    from vggtjax.clips.truth import Truth
    from vggtjax.network.checkpoint import Model

FOLDER = Path(__file__).resolve().parent / "made"
SCENES, SCENE_SEED = 4, 200  # of the gallery: the first of the seed, whatever came out
MATCHED_SCENE = 1  # of the gallery, whose matches are shown
SCENE_FRAMES, SCENE_SIDE = 12, 96
_TURNTABLE: dict[str, Any] = {"seconds": 4.0, "fps": 8.0, "size": (384, 240)}
_BACKGROUND, _TEXT, _FAINT = "#14141a", "#ececf0", "#9696a0"
_FIRST, _SECOND, _FUSED, _TRUE = "#6db7ff", "#ff9a4a", "#7ddc8b", "#f5f5f5"
_STYLE: dict[Any, Any] = {
    "figure.facecolor": _BACKGROUND, "savefig.facecolor": _BACKGROUND, "axes.facecolor": _BACKGROUND,
    "text.color": _TEXT, "axes.labelcolor": _TEXT, "axes.edgecolor": _FAINT, "xtick.color": _FAINT,
    "ytick.color": _FAINT, "axes.titlesize": 10, "axes.titleweight": "normal", "font.size": 9,
    "legend.frameon": False, "axes.spines.top": False, "axes.spines.right": False,
}  # fmt: skip


class Clip(NamedTuple):
    """A clip with its truth, both passes over it, and what each motion cue says: [S, h, w] by name."""

    truth: Truth
    result: Reconstruction
    cues: dict[str, np.ndarray]
    by_matches: Reconstruction | None = None  # the result with masks by matches


def make(folder: Path = FOLDER) -> None:
    """Make all pictures in `folder`, unless those there are of this code, model and clip."""
    import consistency
    import extension
    import matplotlib

    import vggtjax
    from vggtjax.results.films import film_frames, write_film

    stamp = folder / "made-of.txt"
    if stamp.is_file() and stamp.read_text() == made_of():
        return

    vggtjax.enable_compilation_cache()
    matplotlib.use("agg")
    folder.mkdir(parents=True, exist_ok=True)
    stamp.unlink(missing_ok=True)
    model = vggtjax.load_model("demo")
    clip = _demo_clip(model)
    with matplotlib.rc_context(_STYLE):
        for name, draw in {"passes": passes, "cues": cues, "mask": mask, "fusion": fusion}.items():
            _save(draw(clip), folder / f"{name}.webp")
        scenes = _generated(model)
        _save(matches(model, scenes[MATCHED_SCENE]), folder / "matches.webp")
        fitted = consistency.fitted(model, MATCHED_SCENE, SCENE_SEED, SCENE_FRAMES)
        _save(consistency.steps(fitted), folder / "consistency.webp")
        _save(consistency.surfaces(fitted), folder / "surfaces.webp")
        _save(extension.grown(model, MATCHED_SCENE, SCENE_SEED, 2 * SCENE_FRAMES, SCENE_SIDE), folder / "extended.webp")
        for number, scene in enumerate(scenes):
            _save(gallery_sheet(scene, number), folder / f"scene-{number}.webp")
            write_film(folder / f"turntable-{number}.webp", film_frames(scene.result, **_TURNTABLE), _TURNTABLE["fps"])
    stamp.write_text(made_of())


def made_of() -> str:
    """Return a digest of all that the pictures are made of."""
    import vggtjax

    digest = hashlib.sha256(vggtjax.__version__.encode())
    embedded = Path(vggtjax.__file__).parent / "pipeline/pretrained"
    code = (Path(__file__), *(Path(__file__).with_name(f"{name}.py") for name in ("consistency", "extension")))
    for path in (*code, embedded / "model.safetensors", embedded / "clip.npz"):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _demo_clip(model: Model) -> Clip:
    import jax

    import vggtjax
    from vggtjax.method.cues import GramCues
    from vggtjax.network.backbone import ClipBatch
    from vggtjax.network.model import predict
    from vggtjax.pipeline.pretrained.embedded import demo_clip

    truth, config = demo_clip(), model.config
    clip = vggtjax.load_clip(truth.images, model=model, size=truth.images.shape[2])
    result = vggtjax.reconstruct(model, clip, size=truth.images.shape[2], keep_passes=True)
    gram = GramCues(config.motion, config.depth)
    sums = predict(
        model.params, ClipBatch(jax.numpy.asarray(clip.images[None])), config, outputs=(), accumulator=gram
    ).cue_sums
    assert sums is not None
    shape = result.saliency.shape if result.saliency is not None else ()
    maps = {name: np.asarray(values[0]).reshape(shape) for name, values in gram.maps(sums).items()}
    inverted = {cue.name: cue.inverted for cue in config.motion.cues}
    shown = {f"1 - {name}" if inverted[name] else name: 1 - m if inverted[name] else m for name, m in maps.items()}
    return Clip(truth, result, shown)


def _generated(model: Model) -> list[Clip]:
    """Return the first held-out scenes of a seed that neither training nor a benchmark draws, reconstructed."""
    import vggtjax
    from vggtjax.clips.truth import Truth
    from vggtjax.training.scenes.config import SceneConfig
    from vggtjax.training.scenes.held_out import held_out_scenes

    config = SceneConfig(height=SCENE_SIDE, width=SCENE_SIDE, frames=SCENE_FRAMES)
    scenes = held_out_scenes("dynamic", SCENES, config, seed=SCENE_SEED)
    found = []
    for number in range(SCENES):
        truth = Truth(*(getattr(scenes, name)[number] for name in Truth._fields))
        clip = vggtjax.load_clip(truth.images, model=model, size=SCENE_SIDE)
        paper, by_matches = (vggtjax.reconstruct(model, clip, method=name) for name in ("4dvggt-d", "4dvggt-m"))
        found.append(Clip(truth, paper, {}, by_matches))
    return found


def passes(clip: Clip) -> Figure:
    """Pictures, the tokens whose keys the second pass ignores, depth of both passes and truth; cameras from above."""
    from matplotlib import pyplot

    from vggtjax.research.evaluation.metrics.depth import median_scale

    truth, result = clip.truth, clip.result
    first, second = (np.asarray(p.depth[0]) for p in (result.passes.first, result.passes.second))
    patch = result.depth.shape[1] // (result.saliency.shape[1] if result.saliency is not None else 1)
    blocks = result.dynamic_mask.reshape(len(first), -1, patch, first.shape[2] // patch, patch).any(axis=(2, 4))
    hidden = blocks.repeat(patch, axis=1).repeat(patch, axis=2)
    frames = (2, 7, 12)
    figure = pyplot.figure(figsize=(11.5, 4.7), layout="constrained")
    grid = figure.add_gridspec(3, 8)
    titles = ("picture", "ignored keys", "depth, pass 1", "depth, pass 2", "true depth")
    for row, frame in enumerate(frames):
        dimmed = np.where(hidden[frame][..., None], 0.25 * result.images[frame], result.images[frame]).astype(np.uint8)
        depths = [values[frame] * median_scale(values, truth.depth) for values in (first, second)]
        shown = [result.images[frame], dimmed, *(_depth(d, truth.depth) for d in (*depths, truth.depth[frame]))]
        for column, (picture, title) in enumerate(zip(shown, titles, strict=True)):
            axes = figure.add_subplot(grid[row, column])
            _image(axes, picture, title if row == 0 else "", f"frame {frame}" if column == 0 else "")
    _cameras(figure.add_subplot(grid[:, 5:]), clip)
    return figure


def cues(clip: Clip) -> Figure:
    """The maps in the frame where most moves, before the floor is added, and the saliency that is their product."""
    from matplotlib import pyplot

    result, moving = clip.result, clip.truth.dynamic_mask
    frame = int(moving.sum(axis=(1, 2)).argmax())
    assert result.saliency is not None
    maps = clip.cues | {"saliency: the product": result.saliency}
    columns = 5
    rows = math.ceil((len(maps) + 2) / columns)
    figure, axes = pyplot.subplots(rows, columns, figsize=(11.5, 2.4 * rows), layout="constrained")
    cells = iter(axes.ravel())
    _image(next(cells), result.images[frame], f"picture, frame {frame}")
    for name, values in maps.items():
        _image(next(cells), values[frame], name.replace("_", " "), cmap="inferno", vmin=0, vmax=1)
    _image(next(cells), moving[frame], "what moves (truth)", cmap="gray", vmin=0, vmax=1)
    for cell in cells:
        cell.set_axis_off()
    return figure


def mask(clip: Clip) -> Figure:
    """The histogram of the saliency of all pixels with the threshold, and the mask it gives."""
    from matplotlib import pyplot

    from vggtjax.method.mask import BINS, find_threshold, upsample
    from vggtjax.results.previews import overlay

    result, frames = clip.result, (2, 7, 12)
    assert result.saliency is not None
    pixels = np.asarray(upsample(result.saliency[None], result.depth.shape[1:3]))[0]  # pyright: ignore
    kind = result.settings.get("threshold", "otsu")  # absent where it is the method's own
    threshold = float(find_threshold(pixels, kind))  # pyright: ignore
    figure = pyplot.figure(figsize=(11.5, 5.0), layout="constrained")
    grid = figure.add_gridspec(3, 7)
    axes = figure.add_subplot(grid[:, :4])
    low = pixels[pixels < threshold]
    width = float(np.ptp(pixels)) * 4 / BINS
    edges = threshold + width * np.arange(-np.ceil(threshold / width), np.ceil((1 - threshold) / width) + 1)
    axes.hist(low, edges, color="#5b5b8f", label=f"static: {low.size / pixels.size:.0%} of the pixels")
    axes.hist(pixels[pixels >= threshold], edges, color=_SECOND, label=f"dynamic: {1 - low.size / pixels.size:.0%}")
    axes.axvline(threshold, color=_TRUE, linewidth=1.2)
    axes.annotate(f"{kind}: {threshold:.2f}", (threshold, axes.get_ylim()[1] * 0.8), (8, 0),
                  textcoords="offset points")  # fmt: skip
    axes.set(xlabel="saliency", ylabel="pixels of all frames", title="one threshold for the clip")
    axes.legend(loc="upper right")
    for row, frame in enumerate(frames):
        found, true = (overlay(result.images[frame], of.dynamic_mask[frame]) for of in (result, clip.truth))
        shown = ((pixels[frame], "saliency, pixels"), (found, "mask"), (true, "truth"))
        for column, (picture, title) in enumerate(shown):
            axes = figure.add_subplot(grid[row, 4 + column])
            limits: dict[str, Any] = {"cmap": "inferno", "vmin": 0, "vmax": 1} if picture.ndim == 2 else {}
            _image(axes, picture, title if row == 0 else "", f"frame {frame}" if column == 0 else "", **limits)
    return figure


def fusion(clip: Clip) -> Figure:
    """Confidence of both passes, the weight of the second, and the errors of both and of the fused depth."""
    from matplotlib import pyplot

    from vggtjax.research.evaluation.metrics.depth import median_scale

    truth, result = clip.truth, clip.result
    both = (result.passes.first, result.passes.second)
    confidence = [np.asarray(p.depth_confidence[0]) for p in both]
    depths = [*(np.asarray(p.depth[0]) for p in both), result.depth]
    weight = np.where(result.dynamic_mask, 0, confidence[1] / (confidence[0] + confidence[1]))
    errors = [np.abs(d * median_scale(d, truth.depth) - truth.depth) / truth.depth for d in depths]
    frames = (2, 7, 12)
    figure, axes = pyplot.subplots(len(frames), 7, figsize=(11.5, 5.1), layout="constrained")
    titles = ["picture", "confidence,\npass 1", "confidence,\npass 2", "weight of\npass 2"]
    for name, error in zip(("pass 1", "pass 2", "fused"), errors, strict=True):
        titles.append(f"error, {name}\nmean {error.mean():.3f}")
    most = float(np.percentile(np.concatenate(confidence), 99))
    ways: tuple[dict[str, Any], ...] = (
        {}, *[{"cmap": "viridis", "vmin": 1, "vmax": most}] * 2, {"cmap": "cividis", "vmin": 0, "vmax": 1},
        *[{"cmap": "magma", "vmin": 0, "vmax": 1}] * 3,
    )  # fmt: skip
    drawn = {}
    for row, frame in zip(axes, frames, strict=True):
        shown = (result.images, *confidence, weight, *errors)
        for column, (cell, values) in enumerate(zip(row, shown, strict=True)):
            title = titles[column] if frame == frames[0] else ""
            drawn[column] = _image(cell, values[frame], title, f"frame {frame}" if column == 0 else "", **ways[column])
    for columns, label in (((1, 2), "confidence"), ((3,), "0: pass 1 alone"), ((4, 5, 6), "|d - true| / true")):
        figure.colorbar(drawn[columns[0]], ax=list(axes[:, columns].ravel()), location="bottom", label=label,
                        fraction=0.05, aspect=12 * len(columns), pad=0.03)  # fmt: skip
    return figure


def matches(model: Model, clip: Clip) -> Figure:
    """Each step from the matches of three frames to their mask, and the truth."""
    import dataclasses

    import jax
    from matplotlib import pyplot

    from vggtjax.cameras import Cameras
    from vggtjax.method.matching.adjustment import Adjustment, adjust, at_patches
    from vggtjax.method.matching.matched_mask import motion_pixels
    from vggtjax.method.matching.matched_motion import motion
    from vggtjax.method.matching.matches import frame_pairs, patch_centres
    from vggtjax.method.passes import first_pass
    from vggtjax.network.backbone import ClipBatch
    from vggtjax.network.heads.pose import decode_pose
    from vggtjax.results.previews import overlay

    truth, result = clip.truth, clip.by_matches
    assert result is not None
    images = jax.numpy.asarray(result.images[None] / np.float32(255))
    first, seen = jax.jit(first_pass, static_argnames=("config", "witness"))(
        model.params, ClipBatch(images), config=model.config, witness="matches"
    )
    grid = seen.saliency.shape[2:]
    found = jax.tree.map(lambda x: x[0], seen.matches)
    depth, cameras = at_patches(first.depth, grid)[0], Cameras(*(x[0] for x in decode_pose(first.pose_encoding, grid)))
    saliency = seen.saliency[0].reshape(depth.shape)
    as_it_is = dataclasses.replace(Adjustment(), annealed=())  # no iteration
    before = adjust(depth, cameras, found.position, found.weight, grid, as_it_is)
    scored = motion(found, saliency, depth, cameras, grid)

    def difference(world: Any) -> np.ndarray:
        """Return the mean distance between matches and a static world, in patches."""
        distance = np.linalg.norm(np.asarray(world.position - found.position), axis=-1)
        weight = np.asarray(found.weight)
        return ((weight * distance).sum(axis=1) / weight.sum(axis=1).clip(1e-6)).reshape(-1, *grid)

    score = np.asarray(scored.score).reshape(-1, *grid)
    pixels = np.asarray(motion_pixels(jax.numpy.asarray(score[None]), images))[0]
    median, patch = float(np.median(score)), model.config.patch_size
    far = {"cmap": "inferno", "vmin": 0, "vmax": 2}
    above = {"cmap": "inferno", "vmin": median, "vmax": 5 * median}
    columns: tuple[tuple[str, Any, dict[str, Any]], ...] = (
        ("1  matches,\n2 frames later", result.images, {}),
        ("cues alone:\nthe saliency", saliency.reshape(-1, *grid), {"cmap": "inferno", "vmin": 0, "vmax": 1}),
        ("difference, cameras\nof the first pass", difference(before), far),
        ("2, 3  difference,\nadjusted cameras", difference(scored.world), far),
        ("4, 5  score,\nafter votes", score, above),
        ("6  at pixels", pixels, above),
        ("mask", result.dynamic_mask, {}),
        ("truth", truth.dynamic_mask, {}),
    )
    frames = (2, 5, 8)
    figure, axes = pyplot.subplots(len(frames), len(columns), figsize=(11.5, 4.9), layout="constrained")
    later = frame_pairs(len(depth)).offsets.index(2)
    for row, frame in zip(axes, frames, strict=True):
        for cell, (title, values, how) in zip(row, columns, strict=True):
            shown = overlay(result.images[frame], values[frame]) if values.dtype == bool else values[frame]
            _image(cell, shown, title if frame == frames[0] else "", f"frame {frame}" if cell is row[0] else "", **how)
        start, end = patch * patch_centres(grid), patch * np.asarray(found.position[frame, later])
        sure = np.asarray(found.weight[frame, later]) > 0.3
        lines = np.stack([start[sure], end[sure]], axis=1).transpose(2, 1, 0)
        row[0].plot(*(lines - 0.5), color="#ffe94a", linewidth=0.8)
    return figure


def gallery_sheet(clip: Clip, number: int) -> Figure:
    """Six frames of a generated scene: picture, depth, objects found by cues and by matches, what truly moves."""
    from matplotlib import pyplot

    from vggtjax.results.previews import moving_ids, overlay

    result, truth = clip.result, clip.truth
    frames = np.linspace(0, len(result.depth) - 1, 6).round().astype(int)
    assert clip.by_matches is not None
    figure, axes = pyplot.subplots(5, len(frames), figsize=(9.2, 7.8), layout="constrained")
    both = (result, clip.by_matches)
    counts = [int(of.instances.max()) for of in both]
    figure.suptitle(f"scene {number}: objects found by cues {counts[0]}, by matches {counts[1]}", fontsize=11)
    for column, frame in enumerate(frames):
        picture = result.images[frame]
        by_cues, by_matches = (overlay(picture, moving_ids(of.dynamic_mask[frame], of.instances[frame])) for of in both)
        rows = {"picture": picture, "depth": _depth(result.depth[frame], result.depth), "by cues": by_cues,
                "by matches": by_matches, "truth": overlay(picture, truth.dynamic_mask[frame])}  # fmt: skip
        for row, (name, values) in enumerate(rows.items()):
            _image(axes[row, column], values, f"frame {frame}" if row == 0 else "", name if column == 0 else "")
    return figure


def _cameras(axes: Any, clip: Clip) -> None:
    """Plot the paths of both passes and the true one from above, in the axes of the first camera."""
    from vggtjax.cameras import checked_centres, umeyama_sim3
    from vggtjax.network.heads.pose import decode_pose

    true = np.asarray(clip.truth.camera_from_world)
    size = clip.result.depth.shape[1:3]
    ways = {"truth": (checked_centres(true), _TRUE)}
    for name, predictions, colour in (
        ("pass 1", clip.result.passes.first, _FIRST), ("pass 2", clip.result.passes.second, _SECOND),
    ):  # fmt: skip
        found = checked_centres(np.asarray(decode_pose(predictions.pose_encoding, size)[0][0]))
        ways[name] = (umeyama_sim3(found, checked_centres(true)).apply(found), colour)
    rotation, origin = true[0, :, :3], checked_centres(true)[0]
    for name, (way, colour) in ways.items():
        x, _, z = ((way - origin) @ rotation.T).T
        axes.plot(x, z, "o-", color=colour, label=name, markersize=3.5, linewidth=1.5)
    axes.set(title="cameras from above, after Sim(3)", xlabel="x, metres", ylabel="z, metres")
    axes.set_aspect("equal", "datalim")
    axes.legend()


def _depth(depth: np.ndarray, of_clip: np.ndarray) -> np.ndarray:
    """Colour inverse depth by the range of the clip's."""
    from vggtjax.results.previews import color_depth, inverse_depth_range

    everywhere = np.ones(of_clip.shape, bool)
    return color_depth(depth, np.ones(depth.shape, bool), inverse_depth_range(of_clip, everywhere))


def _image(axes: Any, pixels: np.ndarray, title: str = "", label: str = "", **how: Any) -> Any:
    axes.set(xticks=[], yticks=[], title=title, ylabel=label)
    for spine in axes.spines.values():
        spine.set_visible(False)
    return axes.imshow(pixels, interpolation="nearest" if pixels.shape[0] < 32 else "bilinear", **how)


def _save(figure: Figure, path: Path) -> None:
    from matplotlib import pyplot

    figure.savefig(path, dpi=130, pil_kwargs={"quality": 88})
    pyplot.close(figure)

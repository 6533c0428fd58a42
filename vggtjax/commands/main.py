"""The command line, a function per command. Does not import jax before it is needed."""

from __future__ import annotations

import atexit
import gc
import logging
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from vggtjax.commands.batch import batch
from vggtjax.commands.calibrate_cues import calibrate_cues
from vggtjax.commands.evaluate import evaluate
from vggtjax.commands.fit_fusion import fit_fusion
from vggtjax.commands.import_result import import_result
from vggtjax.commands.process import keep_freed_memory
from vggtjax.commands.report import Report
from vggtjax.commands.scenes import scenes
from vggtjax.commands.train import train
from vggtjax.config import Gram, Suppress, VGGTConfig
from vggtjax.errors import InputError, VggtjaxError
from vggtjax.options import MethodName, check_smooth_frames
from vggtjax.storage.cache import keep_compilations

if TYPE_CHECKING:
    import numpy as np

    from vggtjax.clips.clip import Clip


def reconstruct(
    source: tyro.conf.Positional[tuple[str, ...]],
    /,
    out: Path,
    *,
    model: str = "demo",
    method: MethodName = "4dvggt-d",
    config: Path | None = None,
    mode: Literal["crop", "pad"] = "crop",
    size: int | None = None,
    fps: float | None = None,
    stride: int = 1,
    start: int = 0,
    max_frames: int | None = None,
    gram: Gram | None = None,
    suppress: Suppress | None = None,
    mask_pairs: int = 5,
    align_scale: bool = False,
    smooth_frames: int = 1,
    masks: Path | None = None,
    no_masks: tyro.conf.FlagCreatePairsOff[bool] = False,
    refine_mask: tyro.conf.FlagCreatePairsOff[bool] = False,
    no_refine_mask: tyro.conf.FlagCreatePairsOff[bool] = False,
    tracks: str | None = None,
    fusion: Path | None = None,
    dtype: Literal["float32", "bfloat16"] = "float32",
    confidence_percentile: float = 20.0,
    resolution: Literal["model", "original"] = "model",
    layout: Annotated[Literal["vggtjax", "vggt4d"], tyro.conf.arg(name="format")] = "vggtjax",
) -> None:
    """Cameras, depth, dynamic masks and a 4-D point cloud of a clip.

    Args:
        source: a folder of images, a pattern, images, or a video.
        out: folder for the results; an earlier result in it is replaced.
        model: "demo", a converted .safetensors, a PyTorch checkpoint, or a hub id such as facebook/VGGT-1B.
        method: which passes give depth and cameras (see the README's table).
        config: JSON file with the configuration of a PyTorch checkpoint that is not VGGT-1B.
        mode: "crop" cuts tall frames, "pad" keeps every pixel and pads to a square.
        size: side in pixels to run at; the model's own by default.
        fps: frames per second to take of a video.
        stride: take every stride-th frame.
        start: index of the first frame to take.
        max_frames: take so many frames at most.
        gram: similarity of the motion cues; the method's own by default.
        suppress: what becomes of the keys of dynamic tokens; the method's own by default.
        mask_pairs: number of pairs of blocks in which they are suppressed.
        align_scale: bring the second pass to the first one's scale before fusing (not in the paper).
        smooth_frames: odd number of frames that the saliency is averaged over before it is cut (not in the papers).
        masks: folder of pictures, bright where something moves, one per frame; mined from the clip by default.
        no_masks: nothing moves; one pass is enough.
        refine_mask: take out of the mask what agrees with other frames, as vggt4d does.
        no_refine_mask: leave the mask as it was mined, with vggt4d too.
        tracks: points to follow: grid:20 for 20 x 20 over the first frame, or a CSV file with columns x, y and, if
            wanted, frame, in pixels of the source.
        fusion: file of a fitted rule of fusion, as vggtjax fit-fusion writes it; the paper's rule by default.
        dtype: of the blocks' matrix products.
        confidence_percentile: leave so many percent of the pixels, the least confident, out of the point clouds.
        resolution: of the files: the model's, or the source's own, with crop, scale and padding undone.
        layout: "vggt4d" writes, beside our own files, the folder vggt4d/ as VGGT4D does.
    """
    if not source:
        raise InputError("no input; name a folder of images, a pattern, images, or a video")
    if masks is not None and no_masks:
        raise InputError("--masks and --no-masks are opposites; give one of them")
    if smooth_frames != 1 and (masks is not None or no_masks):
        raise InputError("--smooth-frames is for masks that are mined; leave it out with --masks and --no-masks")
    if refine_mask and no_refine_mask:
        raise InputError("--refine-mask and --no-refine-mask are opposites; give one of them")
    frames = source[0] if len(source) == 1 else list(source)
    report = Report()
    with report.running():
        _check_early(frames, (start, stride, fps, max_frames), confidence_percentile, out, masks, tracks)
        check_smooth_frames(smooth_frames)
        fitted = None
        if fusion is not None:
            from vggtjax.method.fusion_file import read_fusion

            fitted = read_fusion(fusion, [method])
        loaded = _load_model(report, model, config)
        if fusion is not None:
            from vggtjax.method.fusion_file import warn_if_fitted_otherwise

            warn_if_fitted_otherwise(fusion, loaded, align_scale=align_scale, mask_pairs=mask_pairs)
        with report.stage("load clip") as progress:
            from vggtjax.clips.clip import load_clip

            clip = load_clip(
                frames,
                mode=mode,
                size=loaded.config.image_size if size is None else size,
                patch=loaded.config.patch_size,
                fps=fps,
                stride=stride,
                start=start,
                max_frames=max_frames,
                progress=progress,
            )
            given = _given_masks(clip, masks, no_masks)
            queries = None
            if tracks is not None:
                from vggtjax.clips.queries import parse_queries

                queries = parse_queries(tracks, clip)
        from vggtjax.pipeline.run import reconstruct as run

        result = run(
            loaded,
            clip,
            method=method,
            size=size,
            masks=given,
            refine_mask=True if refine_mask else False if no_refine_mask else None,
            tracks=queries,
            fusion=fitted,
            gram=gram,
            suppress=suppress,
            mask_pairs=mask_pairs,
            align_scale=align_scale,
            smooth_frames=smooth_frames,
            compute_dtype=dtype,
            on_stage=report.stage,
        )
        with report.stage("write") as progress:
            result.save(
                out,
                confidence_percentile=confidence_percentile,
                resolution=resolution,
                layout=layout,
                pictures=clip.pictures() if resolution == "original" else None,
                progress=progress,
            )
    report.summary(result, out, trained=loaded.trained)
    if tracks is not None and model == "demo":
        report.line("The track head of the embedded model is untrained: its tracks show that everything runs, no more.")


def convert(
    source: tyro.conf.Positional[str],
    destination: tyro.conf.Positional[Path],
    /,
    *,
    config: Path | None = None,
    heads: str | None = None,
    dtype: Literal["float32", "bfloat16"] = "float32",
) -> None:
    """Convert a PyTorch VGGT checkpoint to one .safetensors with Flax names, and say what was read and written.

    Args:
        source: a .safetensors file, a sharded one (its index or folder), a .pt or .pth file, or a hub id.
        destination: the .safetensors file to write.
        config: JSON file with the configuration; VGGT-1B by default.
        heads: those to convert, such as camera,depth; all of camera,depth,points,tracks by default.
        dtype: of the written weights.
    """
    report = Report()
    with report.running(), report.stage("convert") as progress:
        from converters import convert as run

        names = None if heads is None else [name.strip() for name in heads.split(",")]
        done = run(source, destination, dtype=dtype, config=_read_config(config), heads=names, progress=progress)
    report.table(done.summary())


def demo(*, out: Path = Path("demo-output"), method: MethodName = "4dvggt-d") -> None:
    """Reconstruct the embedded clip with the embedded model, and measure the ladder of methods against its truth.

    Args:
        out: folder for the results.
        method: which passes give the depth and cameras that are written.
    """
    report = Report()
    with report.running():
        _check_folder(out)
        loaded = _load_model(report, "demo", None)
        with report.stage("load clip"):
            from vggtjax.clips.clip import load_clip
            from vggtjax.pretrained.embedded import demo_clip

            truth = demo_clip()
            clip = load_clip(truth.images, size=truth.images.shape[2], patch=loaded.config.patch_size)
        from vggtjax.pipeline.run import reconstruct as run

        result = run(loaded, clip, method=method, size=truth.images.shape[2], on_stage=report.stage)
        with report.stage("write") as progress:
            from PIL import Image

            from vggtjax.evaluation.picture import truth_sheet
            from vggtjax.storage.writing import writing

            result.save(out, progress=progress)
            sheet = out / "preview" / "truth.png"
            with writing(sheet) as temporary:
                Image.fromarray(truth_sheet(result, truth)).save(temporary)
        with report.stage("measure") as progress:
            from vggtjax.evaluation.ladder import ladder

            rows = ladder(loaded, truth, progress=progress)
    report.summary(result, out, trained=loaded.trained)
    report.ladder(rows)
    report.line(f"Next to the truth: {sheet}")


def info(model: tyro.conf.Positional[str] = "demo", /, *, config: Path | None = None) -> None:
    """Say what a model is: configuration, heads, parameters, dtype.

    Args:
        model: "demo", a converted .safetensors, a PyTorch checkpoint, or a hub id.
        config: JSON file with the configuration of a PyTorch checkpoint that is not VGGT-1B.
    """
    report = Report()
    with report.running():
        loaded = _load_model(report, model, config)
    report.table(loaded.summary())


COMMANDS = {
    "reconstruct": reconstruct,
    "batch": batch,
    "convert": convert,
    "import": import_result,
    "demo": demo,
    "info": info,
    "train": train,
    "evaluate": evaluate,
    "calibrate-cues": calibrate_cues,
    "fit-fusion": fit_fusion,
    "scenes": scenes,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code: 0, 2 for bad input or output, 130 when interrupted."""
    keep_freed_memory()
    atexit.register(gc.freeze)  # at the end there is nothing to collect, and a last collection takes half a second
    logging.basicConfig(format="vggtjax: %(message)s", level=logging.INFO)
    for chatty in ("jax", "absl", "orbax", "matplotlib", "httpx", "httpx2", "huggingface_hub"):
        logging.getLogger(chatty).setLevel(logging.ERROR)
    warnings.showwarning = lambda message, *_, **__: logging.getLogger("vggtjax").warning("%s", message)
    keep_compilations()  # after the line above: it handles some warnings itself
    try:
        tyro.extras.subcommand_cli_from_dict(
            COMMANDS,
            prog="vggtjax",
            description="4-D reconstruction of monocular video of a moving world, in JAX.",
            args=arguments,
        )
    except VggtjaxError as error:
        sys.stderr.write(f"vggtjax: {error}\n")
        return 2
    except MemoryError:  # of the host
        sys.stderr.write("vggtjax: out of memory; take fewer frames (--max-frames, --stride) or a smaller --size\n")
        return 2
    except OSError as error:  # a file that cannot be looked at, in a place that no other message covers
        sys.stderr.write(f"vggtjax: {error.filename or 'a file'}: {error.strerror or error}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("vggtjax: interrupted\n")
        return 130
    return 0


def _check_early(
    frames: str | list[str],
    sampling: tuple,
    confidence_percentile: float,
    out: Path,
    masks: Path | None,
    tracks: str | None,
) -> None:
    """Raise now what would otherwise be raised after minutes of work."""
    from vggtjax.clips.queries import check_words
    from vggtjax.clips.sampling import Sampling
    from vggtjax.clips.sources import open_source
    from vggtjax.results.point_cloud import check_percentile

    Sampling(*sampling)
    open_source(frames)
    if masks is not None:
        open_source(str(masks))
    if tracks is not None:
        check_words(tracks)
    check_percentile(confidence_percentile)
    _check_folder(out)


def _check_folder(out: Path) -> None:
    from vggtjax.results.folder import check_folder

    check_folder(out)


def _given_masks(clip: Clip, folder: Path | None, none: bool) -> np.ndarray | None:
    if folder is not None:
        from vggtjax.clips.masks import load_masks

        return load_masks(folder, clip)
    if none:
        import numpy as np

        return np.zeros(clip.images.shape[:3], bool)
    return None


def _load_model(report: Report, name: str, config: Path | None):
    with report.stage("load model") as progress:
        from vggtjax.pretrained.load import load_model

        return load_model(name, config=_read_config(config), progress=progress)


def _read_config(path: Path | None) -> VGGTConfig | None:
    if path is None:
        return None
    try:
        if path.stat().st_size > 1 << 20:
            raise InputError(f"{path} is {path.stat().st_size} bytes; expected a small JSON file with a configuration")
        return VGGTConfig.from_json(path.read_text())
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path} is not text; expected a JSON file with a configuration") from None

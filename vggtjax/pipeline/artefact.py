"""An artefact: a reconstruction as one program for clips of one shape, with its weights, for others to run.

It is a folder that jax alone runs, without this package: `serve.py` in it is a copy of `pipeline/serve.py`.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from vggtjax.checkpoint import Model, check_finite
from vggtjax.errors import InputError, OutputError, check_choice, whole_number
from vggtjax.method.algorithm import compute_by, run_method
from vggtjax.method.assembly import FusionRule, check_fuses
from vggtjax.method.fusion_file import fusion_digest
from vggtjax.network.model import HEADS
from vggtjax.options import Options
from vggtjax.pipeline import serve
from vggtjax.progress import OnStage, Progress, no_progress, no_stage
from vggtjax.results.report import versions
from vggtjax.storage.tensor_file import Spec, write_tensors
from vggtjax.storage.writing import check_free, writing

PLATFORMS = ("cpu", "cuda", "rocm", "tpu")

_READ = ("backbone", "aggregator", HEADS["camera"], HEADS["depth"])  # the parameters of both passes
# cuDNN's attention: jax does not promise that later versions know this call.
_CUDNN = export.DisabledSafetyCheck.custom_call("__cudnn$fmhaSoftmax")
_ABOUT = {
    "depth": "up to scale",
    "depth_confidence": "at least 1",
    "camera_from_world": "rotation and translation, OpenCV axes, the depth's unit",
    "intrinsics": "in pixels",
    "dynamic_mask": "what moves, as mined",
    "saliency": "of the patches, in [0, 1]",
}


def check_artefact(out: Path, frames: int, height: int, width: int, platforms: Sequence[str], options: Options) -> None:
    """Check what can be checked before the model is loaded.

    Raises InputError for an invalid number or platform and for options whose work is done outside the passes, and
    OutputError where `out` exists or cannot be made.
    """
    whole_number("frames", frames, 1)
    whole_number("height", height, 1)
    whole_number("width", width, 1)
    if not platforms or len(set(platforms)) < len(platforms):
        raise InputError(f"platforms is {list(platforms)}; expected different ones of {', '.join(PLATFORMS)}")
    for platform in platforms:
        check_choice("platforms", platform, PLATFORMS)
    if options.refine_cameras:
        raise InputError("refine_cameras is True; leave it out: bundle adjustment is not a part of the program")
    if options.consistent_depth:
        raise InputError(
            "consistent_depth is True; leave it out: it reads the source's pictures, which a program cannot"
        )
    if options.row.refine:
        raise InputError(
            f"method {options.method} refines its mask on the host, which a program cannot; give refine_mask=False "
            "(--no-refine-mask), and the mask is as it was mined"
        )
    if os.path.lexists(out):
        raise OutputError(f"{out} exists and is not replaced; choose another name, or move it away")
    check_free(out, [], replaced=False, what="artefact")


def write_artefact(
    model: Model,
    out: str | Path,
    *,
    frames: int,
    height: int,
    width: int,
    platforms: Sequence[str] = ("cpu", "cuda"),
    options: Options = Options(),
    fusion: FusionRule | None = None,
    on_stage: OnStage | None = None,
    **changes: Any,
) -> Path:
    """Write the reconstruction of clips of one shape as a folder that jax runs without this package.

    The program takes `images`, float32 [S, H, W, 3], and returns depth, confidence, cameras, mask and saliency: the
    numbers of `infer`. Nothing is compiled here, and no platform needs to be here; kernels of a platform that jax finds
    only there (cuDNN's attention for bfloat16, that for TPUs) are in the program only if it is written there.

    Args:
        model: what `load_model` returned.
        out: the folder, which must not exist; an interrupted run leaves nothing.
        frames: number of frames, S.
        height: of the frames in pixels, a multiple of the model's patch size.
        width: likewise.
        platforms: where the program can run: some of cpu, cuda, rocm and tpu.
        options: the method and its settings.
        fusion: a fitted rule of fusion; the paper's rule if None. It becomes a constant of the program.
        on_stage: called with the name of each stage, returns a context in which the stage runs.
        changes: fields of `options` by name, such as `method="vggt"`.

    Raises:
        InputError: an invalid shape, platform or option, or a method whose mask is refined on the host.
        CheckpointError: the model has parameters that are not finite.
        OutputError: the folder exists or cannot be written.
    """
    out, on_stage = Path(out), on_stage or no_stage
    options = options.changed(**changes).resolved(model.config.motion, "cpu" not in platforms)
    check_artefact(out, frames, height, width, platforms, options)
    check_fuses(fusion, options.method)
    patch = model.config.patch_size
    if height % patch or width % patch:
        raise InputError(f"frames of {width} x {height} pixels; expected multiples of the patch size {patch}")
    if absent := [name for name in ("camera", "depth") if name not in model.heads]:
        raise InputError(f"the model has no head {absent[0]!r}, only {model.heads}; a reconstruction needs it")
    check_finite(model)
    flat, structure = jax.tree_util.tree_flatten_with_path({name: model.params[name] for name in _READ})
    weights = {_name(path): leaf for path, leaf in flat}
    with on_stage("lower"):
        exported = _lowered(model, weights, structure, (frames, height, width), platforms, options, fusion)
    with writing(out) as folder:
        folder.mkdir()
        (folder / serve.PROGRAM).write_bytes(exported.serialize())
        with on_stage("write weights") as progress:
            _write_weights(folder / serve.WEIGHTS, weights, progress or no_progress)
        with on_stage("write manifest"):
            manifest = _manifest(model, exported, options, fusion)
            manifest["files"] = {name: _facts(folder / name) for name in (serve.PROGRAM, serve.WEIGHTS)}
            text = json.dumps(manifest, indent=2, allow_nan=False)
            (folder / serve.MANIFEST).write_text(f"{text}\n", encoding="utf-8")
        shutil.copyfile(serve.__file__, folder / "serve.py")
        _copy_flatbuffers(folder / "flatbuffers")
    return out


def _lowered(
    model: Model,
    weights: dict[str, Any],
    structure: Any,
    shape: tuple[int, int, int],
    platforms: Sequence[str],
    options: Options,
    fusion: FusionRule | None,
) -> export.Exported:
    compute = compute_by(options, on_accelerator="cpu" not in platforms)
    names = list(weights)  # in the order of the structure; jax sorts those of a dictionary

    def reconstruction(weights, images):
        params = jax.tree.unflatten(structure, [weights[name] for name in names])
        assembly, passes = run_method(params, images[None], model.config, options, fusion=fusion, compute=compute)
        outputs = (assembly.depth, assembly.confidence, *assembly.cameras, passes.dynamic_mask, passes.saliency)
        return {name: output[0] for name, output in zip(_ABOUT, outputs, strict=True)}

    shapes = {name: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for name, leaf in weights.items()}
    images = jax.ShapeDtypeStruct((*shape, 3), jnp.float32)
    run = export.export(jax.jit(reconstruction), platforms=tuple(platforms), disabled_checks=[_CUDNN])
    return run(shapes, images)


def _name(path: tuple[Any, ...]) -> str:
    """Return the dotted name of a parameter, or of a part of a quantised one."""
    return ".".join(str(getattr(key, "key", getattr(key, "name", key))) for key in path)


def _write_weights(path: Path, weights: dict[str, Any], progress: Progress) -> None:
    specs = {name: Spec(leaf.shape, np.dtype(leaf.dtype)) for name, leaf in weights.items()}
    written = 0

    def pieces(name: str) -> list[np.ndarray]:
        nonlocal written
        written += 1
        progress(written, len(weights))
        return [np.asarray(weights[name])]

    write_tensors(path, specs, pieces)


def _manifest(model: Model, exported: export.Exported, options: Options, fusion: FusionRule | None) -> dict[str, Any]:
    (_, images), _ = jax.tree.unflatten(exported.in_tree, exported.in_avals)
    outputs = jax.tree.unflatten(exported.out_tree, exported.out_avals)
    return {
        "format": serve.FORMAT,
        "version": serve.VERSION,
        "jax": jax.__version__,
        "calling_convention": exported.calling_convention_version,
        "platforms": list(exported.platforms),
        "model": model.identity.to_json() | ({"note": model.note} if model.note else {}),
        "options": options.to_json(),
        "fusion": fusion_digest(fusion),
        "inputs": {"images": _described(images, "RGB in [0, 1]")},
        "outputs": {name: _described(outputs[name], about) for name, about in _ABOUT.items()},
        "written_by": versions(),
    }


def _described(value: Any, about: str) -> dict[str, Any]:
    return {"shape": list(value.shape), "dtype": str(value.dtype), "about": about}


def _facts(path: Path) -> dict[str, Any]:
    """Return size and digest of a file."""
    with path.open("rb") as file:
        return {"bytes": path.stat().st_size, "sha256": hashlib.file_digest(file, "sha256").hexdigest()}


def _copy_flatbuffers(folder: Path) -> None:
    """Copy the library that jax reads programs with and does not install: a dozen Python files, Apache 2.0."""
    spec = find_spec("flatbuffers")
    if spec is None or not spec.submodule_search_locations:
        raise OutputError("the package flatbuffers is not installed; install it with: pip install flatbuffers")
    folder.mkdir()
    for path in sorted(Path(spec.submodule_search_locations[0]).glob("*.py")):
        shutil.copyfile(path, folder / path.name)

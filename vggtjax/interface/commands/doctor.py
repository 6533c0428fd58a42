"""The command `vggtjax doctor`: what there is on this computer. Does not import jax before it is needed."""

from __future__ import annotations

import json
import platform
import sys
from collections.abc import Iterator
from contextlib import suppress
from importlib.util import find_spec
from math import prod
from typing import Annotated, Any, Literal

import tyro

from vggtjax import __version__
from vggtjax.errors import VggtjaxError, one_line
from vggtjax.interface.commands.flags import InWords
from vggtjax.interface.commands.report import Report
from vggtjax.storage.cache import CONVERTED, cache_folder, cache_parts, clear_cache, size_of
from vggtjax.storage.memory import in_gigabytes
from vggtjax.storage.versions import installed_version

PACKAGES = ("jax", "jaxlib", "flax", "numpy", "scipy", "pillow", "av", "safetensors", "tyro")

# What each extra is for, and its modules.
EXTRAS: dict[str, tuple[str, tuple[str, ...]]] = {
    "cuda": ("NVIDIA GPUs", ("jax_cuda13_plugin",)),
    "hub": ("models by hub id, such as facebook/VGGT-1B", ("huggingface_hub",)),
    "convert": ("PyTorch checkpoints, .pt and .pth", ("torch",)),
    "train": ("vggtjax train, and plots of fits", ("orbax", "matplotlib")),
    "evaluate": ("plots of vggtjax evaluate", ("matplotlib",)),
    "app": ("vggtjax app", ("gradio",)),
    "colmap": ("--refine-cameras, and models of COLMAP", ("pycolmap",)),
    "rerun": ("recordings of rerun by vggtjax export", ("rerun",)),
    "exr": ("OpenEXR files, in and out", ("OpenEXR",)),
    "cluster": ("batches on many machines, lists in parquet", ("ray", "pyarrow")),
    "remote": ("clips and results at URLs", ("fsspec", "aiohttp")),
    "record3d": ("captures of Record3D", ("lzfse",)),
}
_HARDWARE = "cuda"  # no use to most, so it is not advised
_WIDE = (1920, 1080)  # pixels of a video, for the longest clips
_SHAPES = {"16:9": (518, 294), "4:3": (518, 392), "square": (518, 518)}  # width and height of the model's frames
_MEGA = 1e6


_AsJson = Annotated[tyro.conf.FlagCreatePairsOff[bool], tyro.conf.arg(name="json", help_behavior_hint="")]
_Device = InWords[Literal["h100", "h200", "a100", "l4", "rtx4090", "rtx3090"] | None]  # of `memory.GPUS`
_Clear = Annotated[tyro.conf.FlagCreatePairsOff[bool], tyro.conf.arg(name="clear-cache", help_behavior_hint="")]


def doctor(*, device: _Device = None, as_json: _AsJson = False, clear: _Clear = False) -> None:
    """Print versions, devices, memory, the longest clips that fit, extras, and the cache.

    Args:
        device: the longest clips for this GPU, which need not be here, in place of this computer
        as_json: print everything as one JSON object.
        clear: first remove what the cache keeps: compiled programs, converted weights, passes for fits and the like.
    """
    cleared = clear_cache() if clear else None
    report = Report()
    with report.running(), report.stage("look around"):
        found = facts(device)
    if cleared is not None:
        found["cache"]["cleared_bytes"] = cleared
    if as_json:
        sys.stdout.write(json.dumps(found, indent=2) + "\n")
    else:
        _print(report, found)


def facts(gpu: str | None = None) -> dict[str, Any]:
    """Return what the command prints, as JSON values; sizes in bytes, None for what the system does not tell.

    `gpu` names a GPU for the longest clips; by default they are those of this computer.
    """
    import jax

    from vggtjax.storage.backend import backend
    from vggtjax.storage.memory import own_limits, rooms, total_bytes

    backend()
    devices = []
    for device in jax.local_devices():
        stats = device.memory_stats() or {}
        sizes = {"bytes_limit": stats.get("bytes_limit"), "bytes_in_use": stats.get("bytes_in_use")}
        devices.append({"platform": device.platform, "kind": device.device_kind, **sizes})
    parts = {kind: size_of(paths) for kind, paths in cache_parts().items()}
    return {
        "versions": {
            "vggtjax": __version__,
            "python": platform.python_version(),
            "system": platform.platform(),
            **{name: installed_version(name) for name in PACKAGES},
        },
        "devices": devices,
        "memory": {
            "total": total_bytes(),
            "room": [{"bytes": room.size, "limit": room.limit} for room in rooms()],
            "limits": [{"name": name, "bytes": limit, "used": used} for name, limit, used in own_limits()],
        },
        "clips": list(_longest_clips() if gpu is None else _longest_on(gpu)),
        "extras": [
            {"name": name, "for": purpose, "missing": [module for module in modules if find_spec(module) is None]}
            for name, (purpose, modules) in EXTRAS.items()
        ],
        "cache": {"folder": str(cache_folder()), "bytes": sum(parts.values()), "parts": parts},
    }


def _longest_clips() -> Iterator[dict[str, Any]]:
    """Yield the most frames that are predicted to fit at once for each known model, at its own size."""
    from vggtjax.clips.preprocessing import Framing
    from vggtjax.pipeline import memory

    room = memory.available()  # no model is loaded
    for name, model in _known_models():
        width, height = Framing().fitter(model.config).fit(*_WIDE, "").frame_size
        frames = None if room is None else memory.most_frames(model, height, width, room.size)
        yield _clip(name, model.parameter_bytes, width, height, frames)


def _longest_on(gpu: str) -> Iterator[dict[str, Any]]:
    """Yield the most frames that are predicted to fit on a GPU, of models with blocks in bfloat16, by size."""
    import jax

    from vggtjax.config import PUBLISHED
    from vggtjax.network.kernels.narrow import narrowed
    from vggtjax.network.model import parameter_shapes
    from vggtjax.pipeline import memory
    from vggtjax.pipeline.windows.choice import Planned

    room = memory.room_of_gpu(gpu)
    for name, config in PUBLISHED.items():
        shapes = jax.eval_shape(lambda params: narrowed(params, "bfloat16"), parameter_shapes(config))
        size = sum(prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(shapes))
        for shape, (width, height) in _SHAPES.items():
            frames = memory.most_frames(Planned(config, size), height, width, room.size, accelerator=True)
            yield _clip(f"{name} on {gpu}, {shape}", size, width, height, frames)


def _clip(model: str, weights: int, width: int, height: int, frames: int | None) -> dict[str, Any]:
    return {"model": model, "weights": weights, "width": width, "height": height, "frames": frames}


def _known_models() -> Iterator[tuple[str, Any]]:
    """Yield name and size of the embedded model, of published ones, and of the conversions in the cache."""
    import jax
    import numpy as np

    from vggtjax.config import PUBLISHED
    from vggtjax.network.checkpoint import checkpoint_config
    from vggtjax.network.model import parameter_shapes
    from vggtjax.pipeline.pretrained.embedded import MODEL
    from vggtjax.pipeline.windows.choice import Planned

    with suppress(VggtjaxError, OSError):  # a package without its model is no reason to say nothing
        yield "demo", Planned(checkpoint_config(MODEL), MODEL.stat().st_size)
    for name, config in PUBLISHED.items():
        count = sum(prod(leaf.shape) for leaf in jax.tree.leaves(parameter_shapes(config)))
        for dtype in ("float32", "bfloat16"):
            yield f"{name}, {dtype}", Planned(config, count * np.dtype(jax.numpy.dtype(dtype)).itemsize)
    for path in cache_parts()[CONVERTED]:
        with suppress(VggtjaxError, OSError):  # a damaged file is converted anew when it is used
            yield path.stem, Planned(checkpoint_config(path), path.stat().st_size)


def _print(report: Report, found: dict[str, Any]) -> None:
    sections = {
        "Versions": {name: text or "missing" for name, text in found["versions"].items()},
        "Devices": {
            f"{number}": f"{device['platform']}, {one_line(device['kind'], 60)}{_of_device(device)}"
            for number, device in enumerate(found["devices"])
        },
        "Memory": _memory(found["memory"]),
        "Longest clip that is run at once": {clip["model"]: _longest(clip) for clip in found["clips"]}
        | {"longer clips": "are run in windows, and joined"},
        "Extras": {
            extra["name"]: f"{'missing  ' if extra['missing'] else 'installed'}  {extra['for']}"
            for extra in found["extras"]
        },
        "Cache": {
            "folder": found["cache"]["folder"],
            **{kind: f"{size / _MEGA:.1f} MB" for kind, size in found["cache"]["parts"].items()},
            "in all": f"{found['cache']['bytes'] / _MEGA:.1f} MB",
            "empty it": "vggtjax doctor --clear-cache; what is needed is made anew",
            "move it": "VGGTJAX_CACHE=FOLDER",
        },
    }
    if "cleared_bytes" in found["cache"]:
        sections["Cache"]["cleared"] = f"{found['cache']['cleared_bytes'] / _MEGA:.1f} MB"
    for title, rows in sections.items():
        report.line(title)
        report.table({f"  {name}": value for name, value in rows.items()})
        report.line("")
    missing = [extra["name"] for extra in found["extras"] if extra["missing"] and extra["name"] != _HARDWARE]
    if missing:
        command = f"pip install -e '.[{','.join(missing)}]'"
        report.line(f"Missing extras are installed, in the folder of the vggtjax clone, by: {command}")


def _memory(memory: dict[str, Any]) -> dict[str, str]:
    if not memory["room"]:
        return {"free": "not told by this system"}
    total = {} if memory["total"] is None else {"installed": f"{in_gigabytes(memory['total'])}"}
    free = [f"{in_gigabytes(room['bytes'])} {room['limit']}" for room in memory["room"]]
    limits = {limit["name"]: f"{in_gigabytes(limit['bytes'])}" for limit in memory["limits"]}
    return total | {"free": ", ".join(free)} | limits


def _of_device(device: dict[str, Any]) -> str:
    limit = device["bytes_limit"]
    return "" if limit is None else f", {in_gigabytes(device['bytes_in_use'])} of {in_gigabytes(limit)} in use"


def _longest(clip: dict[str, Any]) -> str:
    frames, size = clip["frames"], f"of {clip['width']} x {clip['height']} pixels"
    if frames is None:
        return "unknown: this system does not tell its memory"
    return f"{frames} frame{'s' if frames > 1 else ''} {size}" if frames else f"no clip {size} fits"

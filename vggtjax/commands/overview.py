"""The page of `vggtjax --help`: the commands in the order of use, a line each."""

from __future__ import annotations

from collections.abc import Callable, Mapping

_GROUPS = {
    "Start": {
        "demo": "reconstruct the clip that comes with the package, and measure it",
        "reconstruct": "cameras, depth, masks and a 4-D point cloud of a clip",
        "batch": "the same for many clips; resumes where it was interrupted",
    },
    "Look at results, and pass them on": {
        "view": "play results in a browser, or write them as one page",
        "render": "films of a result: around it, or along its cameras",
        "app": "a page to drop a video on",
        "export": "a result as files of another program",
        "import": "a result of another program as ours",
    },
    "Models": {
        "info": "what a model is made of",
        "convert": "a PyTorch checkpoint of VGGT as one .safetensors",
        "train": "train a model on generated scenes, or finetune one",
        "calibrate-cues": "choose a model's motion cues",
        "fit-fusion": "fit how the two passes are fused",
        "export-model": "a model as a program that jax runs without vggtjax",
    },
    "Measure": {
        "evaluate": "score methods on a data set with ground truth",
        "scenes": "generate clips with exact ground truth",
    },
    "This computer": {
        "doctor": "versions, devices, memory, the longest clips, extras, the cache",
    },
}
_OTHERS = "Others"


def overview(commands: Mapping[str, Callable[..., object]]) -> str:
    """Return the page; commands that no group names come last, with the first line of their docstrings."""
    known = {name for lines in _GROUPS.values() for name in lines}
    rest = {name: (command.__doc__ or "").split("\n")[0] for name, command in commands.items() if name not in known}
    width = max(map(len, commands))
    page = ["usage: vggtjax COMMAND ...", "", "4-D reconstruction of monocular video of a moving world.", ""]
    for title, lines in (_GROUPS | {_OTHERS: rest}).items():
        rows = [f"  {name:<{width}}  {text}" for name, text in lines.items() if name in commands]
        page += [title, *rows, ""] if rows else []
    page += ["vggtjax COMMAND --help tells the options of a command; --version prints the version.", ""]
    return "\n".join(page)

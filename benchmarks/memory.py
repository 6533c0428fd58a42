"""Predicted and measured peak memory of whole processes: python -m benchmarks memory."""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, NamedTuple

import jax
from PIL import Image
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.command_worker import run_command
from benchmarks.suite.report import console
from tests.shared.seeded import seeded_images
from vggtjax.clips.media.arrays import in_bytes
from vggtjax.errors import InputError
from vggtjax.network.checkpoint import Model
from vggtjax.pipeline.memory import predicted_bytes
from vggtjax.pipeline.pretrained.load import load_model
from vggtjax.storage.writing import writing

WITHIN = 0.15  # of the measured peak
_GIGA = 1e9


class Setting(NamedTuple):
    """One run: square or wide frames, the type of the products, the method."""

    frames: int
    height: int
    width: int
    dtype: Literal["float32", "bfloat16"]
    method: str
    devices: int = 1  # into which the CPU is split

    @property
    def words(self) -> list[str]:
        """The options of the command."""
        how = ["--devices", str(self.devices)] if self.devices > 1 else ["--window", "0"]
        return ["--size", str(self.width), "--dtype", self.dtype, "--method", self.method, *how]


EMBEDDED = (
    Setting(8, 64, 64, "float32", "4dvggt-d"),
    Setting(32, 64, 64, "float32", "vggt4d"),
    Setting(64, 64, 64, "float32", "vggt"),
    Setting(32, 64, 64, "bfloat16", "4dvggt-d"),
    Setting(8, 128, 128, "float32", "vggt"),
    Setting(16, 128, 128, "float32", "4dvggt-d"),
    Setting(16, 128, 128, "bfloat16", "vggt4d"),
    Setting(32, 128, 128, "float32", "hard-replacement"),
    Setting(4, 256, 256, "float32", "4dvggt-d"),
    Setting(4, 256, 256, "bfloat16", "vggt"),
    Setting(8, 256, 256, "float32", "vggt4d"),
    Setting(12, 192, 256, "float32", "vggt"),
    Setting(32, 256, 256, "float32", "4dvggt-d"),
    Setting(24, 192, 256, "float32", "vggt4d"),
    Setting(64, 128, 128, "float32", "4dvggt-d"),
    Setting(8, 512, 512, "float32", "4dvggt-d"),
)
SPLIT = (
    Setting(16, 64, 64, "float32", "4dvggt-d", 2),
    Setting(32, 128, 128, "float32", "4dvggt-d", 2),
    Setting(24, 192, 256, "float32", "vggt4d", 2),
    Setting(32, 256, 256, "float32", "4dvggt-d", 2),
    Setting(24, 192, 256, "float32", "vggt", 4),
    Setting(64, 128, 128, "float32", "4dvggt-d", 4),
    Setting(32, 256, 256, "float32", "4dvggt-d", 4),
    Setting(32, 128, 128, "float32", "4dvggt-d", 8),
    Setting(32, 256, 256, "float32", "4dvggt-d", 8),
)
FULL = (
    Setting(2, 294, 518, "float32", "4dvggt-d"),
    Setting(4, 294, 518, "float32", "vggt"),
    Setting(3, 252, 252, "float32", "vggt4d"),
    Setting(2, 294, 518, "bfloat16", "4dvggt-d"),
)


class Row(NamedTuple):
    """Bytes of a setting: predicted, and the peak of a process that compiles its programs."""

    model: str
    setting: Setting
    predicted: float
    measured: float
    own: float  # without mapped files


def memory(*, full: Path | None = None, embedded: bool = True, split: bool = False, out: Path | None = None) -> None:
    """Compare the predicted memory of `vggtjax reconstruct` with the peaks of processes, each of one setting.

    Nothing is taken from the cache, so that every process traces and compiles its programs, as a first run does.

    Args:
        full: a checkpoint of VGGT-1B's size, such as `python -m tests.shared.make_checkpoint` writes and
            `vggtjax convert` converts; its four settings take 8 GB of memory.
        embedded: measure the sixteen settings of the embedded model.
        split: measure nine settings of the embedded model on a CPU that is split into devices.
        out: JSON file for the rows.
    """
    work = [("demo", setting) for setting in EMBEDDED if embedded]
    work += [("demo", setting) for setting in SPLIT if split]
    work += [] if full is None else [(str(full), setting) for setting in FULL]
    if not work:
        raise InputError("nothing is measured; give a checkpoint as full, or leave out --no-embedded")
    if split:  # to predict what such a process takes
        jax.config.update("jax_num_cpu_devices", max(setting.devices for setting in SPLIT))
    models = {name: load_model(name) for name, _ in work}
    rows, screen = [], console()
    table = Table(title="peak memory of a process (GB)", box=None)
    for heading in ("setting", "predicted", "measured", "ratio", "without mapped files"):
        table.add_column(heading, justify="left" if heading == "setting" else "right")
    for name, setting in track(work, "processes", console=Console(stderr=True), transient=True):
        rows.append(row := measured(models[name], name, setting))
        sizes = [f"{value / _GIGA:.2f}" for value in (row.predicted, row.measured)]
        table.add_row(_label(row), *sizes, f"{row.predicted / row.measured:.2f}", f"{row.own / _GIGA:.2f}")
        if out is not None:
            with writing(out) as temporary:
                temporary.write_text(json.dumps([row._asdict() for row in rows], indent=2) + "\n")
    screen.print(table)
    off = [row for row in rows if abs(row.predicted / row.measured - 1) > WITHIN]
    screen.print(f"{len(rows) - len(off)} of {len(rows)} within {100 * WITHIN:.0f} %")


def measured(model: Model, name: str, setting: Setting) -> Row:
    """Run one setting in a process of its own."""
    shape = setting.frames, setting.height, setting.width
    predicted = predicted_bytes(model, *shape, method=setting.method, devices=setting.devices)
    with TemporaryDirectory() as folder:
        frames = Path(folder) / "frames"
        frames.mkdir()
        for number, image in enumerate(seeded_images(*shape).transpose(0, 2, 3, 1)):
            Image.fromarray(in_bytes(image)).save(frames / f"{number:04}.png")
        words = ["reconstruct", str(frames), "--model", name, "--out", f"{folder}/out", *setting.words]
        answer = run_command(words, Path(folder) / "cache", setting.devices)
    return Row("embedded" if name == "demo" else "full", setting, predicted, answer["total"], answer["own"])


def _label(row: Row) -> str:
    frames, height, width, dtype, method, devices = row.setting
    shared = f", {devices} devices" if devices > 1 else ""
    return f"{row.model}, {frames} x {width} x {height}, {dtype}, {method}{shared}"

"""Memory of a device, and communications, by the number of devices that share a clip: python -m benchmarks devices."""

from __future__ import annotations

from rich.table import Table

from benchmarks.suite.cases import DType, Size, config_of, frame_size
from benchmarks.suite.report import console
from vggtjax.checkpoint import Model
from vggtjax.network.model import parameter_shapes
from vggtjax.pipeline.devices import frames_mesh
from vggtjax.pipeline.run import compile_ahead


def devices(
    *,
    counts: tuple[int, ...] = (1, 2, 4, 8),
    frames: int = 32,
    size: Size = "full",
    height: int | None = None,
    width: int | None = None,
    dtype: DType = "float32",
) -> None:
    """Compile the stages of `4dvggt-d` for several numbers of devices; nothing is run, and no weights are needed.

    A CPU is split by XLA_FLAGS=--xla_force_host_platform_device_count=8.

    Args:
        counts: numbers of devices.
        frames: of the clip.
        size: of the model.
        height: of a frame, in pixels; 294 for full by default.
        width: of a frame, in pixels; 518 for full by default.
        dtype: type of the products in the blocks.
    """
    frames_mesh(max(counts))
    config = config_of(size)
    shape = frame_size(size, config, height, width)
    model = Model(config, parameter_shapes(config), size)
    table = Table(title=f"{frames} frames of {shape[1]} x {shape[0]} pixels: temporary and output MB of a device")
    table.add_column("stage")
    needs = {}
    for count in counts:
        table.add_column(f"{count}", justify="right")
        needs[count] = compile_ahead(model, frames, *shape, devices=count, compute_dtype=dtype)
    table.add_column("communications")
    for stage in needs[counts[0]]:
        cells = [f"{need[stage].temporary / 1e6:.1f} + {need[stage].output / 1e6:.1f}" for need in needs.values()]
        kinds = sorted(needs[max(counts)][stage].collectives.items())
        table.add_row(stage, *cells, ", ".join(f"{number} {kind}" for kind, number in kinds))
    console().print(table)

"""The output of the command line: live progress of every stage, and a summary at the end."""

from __future__ import annotations

import shlex
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, SpinnerColumn, Task, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bars
from rich.table import Table
from rich.text import Text

from vggtjax.errors import one_line, printable
from vggtjax.progress import Progress
from vggtjax.storage.memory import peak_bytes

if TYPE_CHECKING:
    from vggtjax.network.checkpoint import Model
    from vggtjax.results.reconstruction import Reconstruction
    from vggtjax.results.report import ErrorTable

_BY_STEP = ("windows",)  # stages whose steps are long enough for a line each in a log
_LISTED_SECONDS = 0.5  # of compiling a program


class Report:
    """Stages with a clock each, on standard error; tables on standard output.

    A terminal shows the stages live; a log gets a line per stage when it is done.
    """

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        self._out = Console()
        self._progress = Bars(
            SpinnerColumn(finished_text="[green]✓"),
            TextColumn("{task.description:<18}", markup=False),
            BarColumn(bar_width=24),
            _Count(),
            TimeElapsedColumn(),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self.seconds: dict[str, float] = {}  # by stage, of those that have ended

    @contextmanager
    def running(self) -> Iterator[None]:
        """Show the stages that run inside."""
        with self._progress:
            yield

    @contextmanager
    def stage(self, name: str) -> Iterator[Progress]:
        """Time a stage and show it; yields the callable that shows its progress.

        Stages that compile say that they come once. Those that a cache makes short are not listed when they are done.
        """
        compiles = name.startswith("compile ")
        label = f"{name} (once for clips of this shape)" if compiles else name
        task = self._progress.add_task(label, total=None)
        started = time.perf_counter()

        def show(done: int, total: int | None) -> None:
            self._progress.update(task, completed=done, total=total)
            if name in _BY_STEP and not self._console.is_terminal:
                self.note(f"{name} {done} of {total}, {time.perf_counter() - started:.1f} s")

        try:
            yield show
        except BaseException:
            self._progress.stop_task(task)  # its clock
            raise
        seconds = time.perf_counter() - started
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds
        total = next(t.total for t in self._progress.tasks if t.id == task) or 1
        is_listed = not compiles or seconds >= _LISTED_SECONDS
        self._progress.update(task, total=total, completed=total, visible=is_listed)
        if is_listed and not self._console.is_terminal:
            self.note(f"{label:<18} {seconds:8.2f} s")

    def summary(self, result: Reconstruction, out: Path, model: Model | None = None) -> None:
        """Print what was reconstructed, by which model, the total time, and where the files are."""
        frames, height, width = result.depth.shape
        pictures = [out / name for name in ("report.html", "preview/sheet.png", "scene.glb") if (out / name).exists()]
        self.table(
            {
                "frames": f"{frames} of {width} x {height} pixels",
                "method": f"{result.method}, model {result.model_name}",
                "dynamic": f"{100 * result.dynamic_share:.1f} % of the pixels" if result.has_mask else "-",
                **{one_line(name, 40): one_line(text) for name, text in result.known_facts.items()},
                "total": f"{sum(self.seconds.values()):.2f} s",
                "peak memory": _peak_memory(),
                "results": f"{out}/",
            }
            | ({"see it": f"vggtjax view {shlex.quote(str(out))}"} if (out / "reconstruction.npz").exists() else {})
            | ({"look at": ", ".join(map(str, pictures))} if pictures else {})
        )
        if model is not None and model.note:
            self.line(model.warning)

    def table(self, rows: Mapping[str, object]) -> None:
        """Print names and values as a table."""
        width = max(len(name) for name in rows)
        for name, value in rows.items():
            self.line(f"{name:<{width}}  {value}")  # never folded: a path can be copied

    def errors(self, errors: ErrorTable) -> None:
        """Print errors against the truth as a table."""
        table = Table(title="errors against the truth", title_justify="left", box=None, pad_edge=False)
        for column, heading in enumerate(errors.headings):
            table.add_column(heading, justify="right" if column > 1 else "left")
        for row in errors.rows:
            table.add_row(*row)
        self._out.print(table, soft_wrap=True)
        for line in errors.note.splitlines():
            self.line(line)

    def means(self, means: Mapping[str, Mapping[str, float]]) -> None:
        """Print the means of an evaluation as a table, a row for every metric and a column for every method."""
        from vggtjax.research.evaluation.tables import ARROWS, best, cell, shown_columns

        table = Table(box=None, pad_edge=False)
        for name in ("", *means):
            table.add_column(Text(name), justify="right" if name else "left", no_wrap=True)
        for column in shown_columns(means):
            top = best(means, column)
            cells = {name: cell(row, column) for name, row in means.items()}
            bold = (f"[bold]{text}[/]" if name in top else text for name, text in cells.items())
            table.add_row(f"{column.heading} {ARROWS[column.better]}", *bold)
        self._out.print(table, soft_wrap=True)

    def note(self, text: str) -> None:
        """Print one line among the stages, on standard error."""
        self._console.print(Text(printable(text)), soft_wrap=True)

    def line(self, text: str) -> None:
        """Print one line on standard output."""
        self._out.print(Text(printable(text)), soft_wrap=True)


class _Count(MofNCompleteColumn):
    """Steps done of all steps, where there is more than one."""

    def render(self, task: Task) -> Text:
        return super().render(task) if task.total and task.total > 1 else Text()


def _peak_memory() -> str:
    peak = peak_bytes()
    if peak is None:
        return "not measured on this system"
    text = f"{peak / 1e9:.2f} GB of host memory"
    import jax

    statistics = jax.local_devices()[0].memory_stats() or {}
    if "peak_bytes_in_use" in statistics:
        text += f", {statistics['peak_bytes_in_use'] / 1e9:.2f} GB of device memory"
    return text

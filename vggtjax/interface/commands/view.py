"""The command `vggtjax view`, and `--view` of other commands. Does not import jax."""

from __future__ import annotations

import os
import sys
import threading
import time
import webbrowser
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from vggtjax.errors import InputError, VggtjaxError
from vggtjax.interface.commands.arguments import Overwrite, QuaternionOrder
from vggtjax.interface.commands.flags import InWords, Switch
from vggtjax.interface.commands.report import Report
from vggtjax.results.saving import ReadFormat
from vggtjax.storage.interruption import handled
from vggtjax.storage.writing import check_file

if TYPE_CHECKING:
    from vggtjax.results.reconstruction import Reconstruction
    from vggtjax.results.result import Result

_POINTS = 500_000, 1_500_000  # static and moving ones that are served; a file that is mailed has fewer
_LOOK = 1.0  # seconds between looks at whether a result was replaced
_RESULTS = tyro.conf.arg(metavar="RESULT [RESULT ...]", help_behavior_hint="(required)")


@dataclass(frozen=True)
class Serving:
    """Where the viewer is served.

    Attributes:
        host: address to serve on: this machine alone by default; on any other address the viewer asks for a token,
            which is printed
        port: port to serve on; 0 takes a free one
        no_browser: open no browser; over ssh none is opened
    """

    host: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "127.0.0.1"
    port: int = 8080
    no_browser: Switch = False


def view(
    results: Annotated[tuple[Path, ...], tyro.conf.Positional, _RESULTS],
    /,
    *,
    export: InWords[Path | None] = None,
    overwrite: Overwrite = False,
    format: ReadFormat = "vggtjax",
    quaternion: QuaternionOrder = None,
    serving: Annotated[Serving, tyro.conf.arg(name="server")] = Serving(),
) -> None:
    """See results in a browser: play them, turn them, compare them; or write them as one file that opens offline.

    Args:
        results: folders of results, up to nine; several are shown side by side or swapped by a key.
        export: write this .html file, which holds everything and opens without a server, and end; by default the
            viewer is served.
        overwrite: replace the file if it exists.
        format: the program whose files the folders have.
        quaternion: order of the quaternions in pred_traj.txt.
        serving: where the viewer is served
    """
    if not results:
        raise InputError("no result; name the folder of one, such as demo-output")
    if export is not None and export.suffix != ".html":
        other = "; vggtjax export --to rerun writes a recording" if export.suffix == ".viser" else ""
        raise InputError(f"export is {export}; expected a name that ends with .html{other}")
    report = Report()
    with report.running():
        from vggtjax.results.folder import check_no_part
        from vggtjax.results.foreign import check_format
        from vggtjax.results.viewer.page import check_count

        check_count(len(results))
        check_format(format, quaternion)
        if export is not None:
            check_file(export, overwrite=overwrite, sources=results)
            for path in results:
                check_no_part(
                    [export], path, what="no page replaces it; choose another name", foreign=format != "vggtjax"
                )
        with report.stage("read") as progress:
            from vggtjax.results.reconstruction import Reconstruction

            loaded, times = [], _times(results) if format == "vggtjax" else None
            for number, path in enumerate(results):
                loaded.append(Reconstruction.load(path, format=format, quaternion=quaternion))
                progress(number + 1, len(results))
        names = _names(results)
        if export is not None:
            with report.stage("choose points") as progress:
                from vggtjax.results.viewer.page import Viewer, viewer_page

                Viewer(viewer_page(loaded, names=names, progress=progress)).save(export)
    if export is not None:
        report.line(f"Open in a browser: {export}")
    else:
        serve(report, loaded, names, serving, None if times is None else _changed(results, times))


def serve(
    report: Report,
    results: Sequence[Result],
    names: Sequence[str],
    serving: Serving = Serving(port=0),
    changed: Iterator[Sequence[Result]] | None = None,
) -> None:
    """Serve the viewer, say where, open a browser, and wait for Ctrl-C; `changed` yields results that were replaced."""
    from vggtjax.results.viewer.server import PageServer

    with PageServer(host=serving.host, port=serving.port) as server:  # a port in use is found before the work
        with report.running(), report.stage("choose points") as progress:
            from vggtjax.results.viewer.page import viewer_page
            from vggtjax.results.viewer.scene import Budget

            page_of = partial(viewer_page, names=names, budget=Budget(*_POINTS))
            server.show(page_of(results, progress=progress))
        report.line(f"The viewer: {server.access.url}   (Ctrl-C ends it)")
        if connection := os.environ.get("SSH_CONNECTION", "").split():
            if server.access.token is None:
                port = server.server_port
                report.line(f"On your own machine, first: ssh -L {port}:{serving.host}:{port} {connection[2]}")
        elif not serving.no_browser and not _open_browser(server.access.url):
            report.line("No browser could be opened here; open the address in one.")

        def follow(replaced: Iterator[Sequence[Result]]) -> None:
            for new in replaced:
                with suppress(VggtjaxError):
                    server.show(page_of(new))

        if changed is not None:
            threading.Thread(target=follow, args=[changed], daemon=True).start()
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            handled()
            report.line("The viewer has ended.")


def _times(paths: Sequence[Path]) -> list[int]:
    """Return when the archive of each result was written; 0 while it is replaced."""
    from vggtjax.results.folder import find_archive

    found = []
    for path in paths:
        try:
            found.append((find_archive(path) if path.is_dir() else path).stat().st_mtime_ns)
        except OSError:
            found.append(0)
    return found


def _changed(paths: Sequence[Path], known: list[int]) -> Iterator[list[Reconstruction]]:
    """Yield the results whenever one of them has been replaced, as one that grows, since the times of `known`."""
    from vggtjax.results.reconstruction import Reconstruction

    while True:
        time.sleep(_LOOK)
        if (now := _times(paths)) == known or 0 in now:
            continue
        with suppress(VggtjaxError):  # while it is replaced; the next look finds it whole
            yield [Reconstruction.load(path) for path in paths]
            known = now


def _names(paths: Sequence[Path]) -> list[str]:
    """Return the paths without the folders that all of them share."""
    resolved = [path.resolve() for path in paths]
    if len(set(resolved)) < 2:
        return [path.name or str(path) for path in resolved]
    common = Path(os.path.commonpath(resolved))
    return [str(path.relative_to(common)) if path != common else path.name for path in resolved]


def _open_browser(url: str) -> bool:
    """Open a browser with windows; return whether there is one."""
    has_screen = sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    try:
        return bool(has_screen) and webbrowser.open(url)
    except webbrowser.Error:
        return False

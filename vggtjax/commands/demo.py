"""The command `vggtjax demo`. Does not import jax before it is needed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from vggtjax.commands.models import load
from vggtjax.commands.report import Report
from vggtjax.commands.view import serve
from vggtjax.options import MethodName, Options
from vggtjax.storage.flags import Switch


def demo(
    *,
    out: Path = Path("demo-output"),
    method: MethodName = "4dvggt-m",
    view: Switch = False,
) -> None:
    """Reconstruct the embedded clip with the embedded model, and measure the ladder of methods against its truth.

    Args:
        out: folder for the results.
        method: which passes give the depth and cameras that are written.
        view: open the viewer at the end; `vggtjax view` has its options.
    """
    report = Report()
    with report.running():
        from vggtjax.results.folder import check_folder

        check_folder(out)
        model = load(report, "demo")
        with report.stage("load clip"):
            from vggtjax.clips.clip import load_clip
            from vggtjax.pretrained.embedded import demo_clip

            truth = demo_clip()
            size = truth.images.shape[2]
            clip = load_clip(truth.images, model=model, size=size)
        from vggtjax.pipeline.run import reconstruct

        result = reconstruct(model, clip, options=Options(method), size=size, on_stage=report.stage)
        result = replace(result, settings=result.settings | {"clip": "Embedded clip"})
        with report.stage("measure") as progress:
            from vggtjax.evaluation.ladder import error_table, ladder

            errors = error_table(ladder(model, truth, masks=("mined", "matches", "true"), progress=progress))
        with report.stage("write") as progress:
            from PIL import Image

            from vggtjax.evaluation.picture import truth_sheet
            from vggtjax.results.report import RunFacts
            from vggtjax.storage.writing import writing

            beside = truth_sheet(result, truth)
            result.save(out, progress=progress, facts=RunFacts(report.seconds, errors, beside))
            sheet = out / "preview" / "truth.png"
            with writing(sheet) as temporary:
                Image.fromarray(beside).save(temporary)
            page = out / "preview" / "viewer.html"
            result.view(names=["demo"]).save(page)
    report.summary(result, out, model)
    report.errors(errors)
    report.line(f"Next to the truth: {sheet}")
    report.line(f"Double-click to see it move: {page}")
    if view:
        serve(report, [result], ["demo"])

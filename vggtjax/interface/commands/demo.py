"""The command `vggtjax demo`. Does not import jax before it is needed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from vggtjax.interface.commands.arguments import CONSISTENT
from vggtjax.interface.commands.flags import Switch
from vggtjax.interface.commands.models import load
from vggtjax.interface.commands.report import Report
from vggtjax.interface.commands.view import serve
from vggtjax.options import MethodName, Options


def demo(*, out: Path = Path("demo-output"), method: MethodName = "4dvggt-m", view: Switch = False) -> None:
    """Reconstruct the clip of the package with the model of the package, and compare four methods with its truth.

    The methods are vggt, pose-decoupling, hard-replacement and 4dvggt-d. Depth and cameras of the result are fitted to
    the pixels (--consistent-depth of reconstruct); the viewer also shows them as predicted.

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
            from vggtjax.pipeline.pretrained.embedded import demo_clip

            truth = demo_clip()
            size = truth.images.shape[2]
            clip = load_clip(truth.images, model=model, size=size)
        from vggtjax.pipeline.agreement import agree_with_pixels
        from vggtjax.pipeline.run import reconstruct
        from vggtjax.pipeline.running import Running
        from vggtjax.results.result import without_mask

        running = Running(is_part=True, on_stage=report.stage)
        predicted = reconstruct(model, clip, options=Options(method), running=running, size=size)
        predicted = replace(predicted, settings=predicted.settings | {"clip": "Embedded clip"})
        result = agree_with_pixels(predicted, clip.pictures, CONSISTENT, on_stage=report.stage)
        predicted, result = without_mask(predicted), without_mask(result)
        with report.stage("measure") as progress:
            from vggtjax.pipeline.pretrained.embedded import SECOND_PASS
            from vggtjax.research.evaluation.ladder import ladder, score_result
            from vggtjax.research.evaluation.ladder_words import error_table, read_second_pass

            rows = ladder(model, truth, masks=("mined", "matches", "true"), progress=progress)
            source = "mined" if result.motion is None else "pixels"
            errors = error_table(rows, score_result(result, truth, source), read_second_pass(SECOND_PASS))
        with report.stage("write") as progress:
            from PIL import Image

            from vggtjax.research.evaluation.picture import truth_sheet
            from vggtjax.results.report import RunFacts
            from vggtjax.storage.writing import writing

            beside = truth_sheet(result, truth, predicted)
            result.save(out, progress=progress, facts=RunFacts(report.seconds, errors, beside))
            sheet = out / "preview" / "truth.png"
            with writing(sheet) as temporary:
                Image.fromarray(beside).save(temporary)
            page = out / "preview" / "viewer.html"
            result.view(predicted, names=["consistent depth", "as predicted"]).save(page)
    report.summary(result, out, model)
    report.errors(errors)
    report.line(f"Next to the truth: {sheet}")
    report.line(f"Double-click to see it move: {page}")
    if view:
        serve(report, [result, predicted], ["consistent depth", "as predicted"])

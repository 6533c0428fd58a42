"""The command `vggtjax reconstruct`. Does not import jax before it is needed."""

from __future__ import annotations

import dataclasses
from typing import Annotated

import tyro

from vggtjax.clips.media.sampling import Sampling
from vggtjax.errors import InputError
from vggtjax.interface.commands.arguments import CONSISTENT, ResultFolder, Shots, Sources, View
from vggtjax.interface.commands.clip_options import GivenInputs
from vggtjax.interface.commands.models import ModelFiles
from vggtjax.interface.commands.report import Report
from vggtjax.interface.commands.view import serve
from vggtjax.pipeline.batch.recipe import ClipRecipe
from vggtjax.pipeline.windows.plan import Windows


def reconstruct(
    source: Sources,
    /,
    *,
    files: Annotated[ModelFiles, tyro.conf.arg(name="model", help="")] = ModelFiles(),
    recipe: Annotated[ClipRecipe, tyro.conf.arg(name="", help="")] = ClipRecipe(options=CONSISTENT),
    given: Annotated[GivenInputs, tyro.conf.arg(name="input", help="")] = GivenInputs(),
    windows: Annotated[Windows, tyro.conf.arg(name="limits", help="")] = Windows(),
    shots: Shots = "keep",
    out: ResultFolder,
    view: View = False,
) -> None:
    """Cameras, depth, dynamic masks and a 4-D point cloud of a clip.

    Args:
        source: a folder of images, a pattern, images, a video, or a capture of an app (Record3D, COLMAP, ...).
        files: the model
        recipe: how the clip is read, reconstructed and written
        given: masks and points of your own
        windows: how a long clip is cut
        shots: whether each shot gets a result of its own
        out: folder for the result
        view: whether the viewer opens at the end
    """
    if not source:
        raise InputError("no input; name a folder of images, a pattern, images, or a video")
    frames = source[0] if len(source) == 1 else list(source)
    report = Report()
    with report.running():
        from vggtjax.clips.media.images import ImageFiles
        from vggtjax.clips.shots import shot_samplings
        from vggtjax.clips.sources import open_source
        from vggtjax.pipeline.devices import frames_mesh
        from vggtjax.pipeline.known.given import check_readable
        from vggtjax.pipeline.refinement.refine import check_refinement
        from vggtjax.results.folder import check_folder, check_no_part

        given.check(recipe, windows)
        opened = open_source(frames, undistort=recipe.undistort)
        opened.total(recipe.sampling)
        next(opened.frames(Sampling()))  # finds a broken source before the model is loaded, which takes longer
        check_refinement(recipe.options.refine_cameras, recipe.known.poses is not None)
        check_readable(recipe.known)
        frames_mesh(recipe.devices)
        samplings = {out: recipe.sampling}
        if shots == "split":
            given.check_one_shot()
            with report.stage("find shots"):
                found = shot_samplings(opened, recipe.sampling)
            samplings = {out / f"shot_{number}": sampling for number, sampling in enumerate(found, start=1)}
        for folder in samplings:
            check_folder(folder, recipe.saving.names(tracks=given.tracks is not None))
        taken = opened.paths if isinstance(opened, ImageFiles) else [getattr(opened, "path", out)]
        check_no_part(taken, out, what="is an input of this run, which would replace that result; choose another --out")
        network, fitted, options = files.load_fastest(report, recipe.options, [recipe.options.method])
        recipe = dataclasses.replace(recipe, options=options)
        from vggtjax.interface.commands.one_clip import OneClip

        results = {}
        for folder, sampling in samplings.items():
            if shots == "split":
                report.note(
                    f"{folder.name} of {len(samplings)}: from frame {sampling.start}, {sampling.max_frames} frames"
                )
            own = dataclasses.replace(recipe, sampling=sampling)
            results[folder] = OneClip(report, frames, network, fitted, own, given, folder, opened).run(windows)
    for folder, result in results.items():
        report.summary(result, folder, network)
    if given.tracks is not None and "tracks" in network.untrained_heads:
        report.line("The track head of this model is untrained: its tracks show that everything runs, no more.")
    if view:
        serve(report, list(results.values()), list(map(str, results)))

"""The command `vggtjax reconstruct`. Does not import jax before it is needed."""

from __future__ import annotations

from typing import Annotated

import tyro

from vggtjax.clips.preprocessing import Framing
from vggtjax.commands.arguments import Devices, Frames, Method, Output, ResultFolder, Size, Sources, Unchecked, View
from vggtjax.commands.clip_options import ExtraOptions, GivenInputs
from vggtjax.commands.models import ModelFiles
from vggtjax.commands.report import Report
from vggtjax.commands.view import serve
from vggtjax.errors import InputError
from vggtjax.media.sampling import Sampling
from vggtjax.options import Options
from vggtjax.results.saving import Saving

_NOTHING_GIVEN, _PLAIN = GivenInputs(), ExtraOptions()


def reconstruct(
    source: Sources,
    /,
    *,
    sampling: Frames = Sampling(),
    framing: Size = Framing(),
    files: Annotated[ModelFiles, tyro.conf.arg(name="model", help="")] = ModelFiles(),
    options: Method = Options(),
    devices: Devices = 1,
    known: Annotated[GivenInputs, tyro.conf.arg(name="mask and track", help="")] = _NOTHING_GIVEN,
    more: Annotated[ExtraOptions, tyro.conf.arg(name="", help="")] = _PLAIN,
    unchecked: Unchecked = False,
    out: ResultFolder,
    saving: Output = Saving(),
    view: View = False,
) -> None:
    """Cameras, depth, dynamic masks and a 4-D point cloud of a clip.

    Args:
        source: a folder of images, a pattern, images, a video, or a capture of an app (Record3D, COLMAP, ...).
        sampling: which frames of the source
        framing: how frames are fitted to the model
        files: the model
        options: how the clip is reconstructed
        devices: how many devices share the frames
        known: masks and points of your own
        more: known cameras and lengths, and how a long clip is cut
        unchecked: whether the memory is left unchecked
        out: folder for the result
        saving: how the result is written
        view: whether the viewer opens at the end
    """
    if not source:
        raise InputError("no input; name a folder of images, a pattern, images, or a video")
    if devices > 1 and more.windows.window:
        raise InputError("--devices and --window exclude each other: a window is run on one device")
    if devices > 1 and known.tracks is not None:
        raise InputError("--devices and --tracks exclude each other: points are followed on one device")
    frames = source[0] if len(source) == 1 else list(source)
    report = Report()
    with report.running():
        from vggtjax.clips.sources import open_source
        from vggtjax.known.given import check_readable
        from vggtjax.pipeline.devices import frames_mesh
        from vggtjax.refinement.refine import check_refinement
        from vggtjax.results.folder import check_folder

        opened = open_source(frames)
        opened.total(sampling)
        next(opened.frames(Sampling()))  # finds a broken source before the model is loaded, which takes longer
        windows, geometry = more.windows, more.geometry
        known.check(options, windows)
        check_refinement(options.refine_cameras, geometry.poses is not None)
        check_readable(geometry)
        frames_mesh(devices)
        check_folder(out, saving.names(tracks=known.tracks is not None))
        network, fitted = files.load(report, options, [options.method])
        fitter = framing.fitter(size=network.config.image_size, patch=network.config.patch_size)
        from vggtjax.commands.one_clip import OneClip

        clip = OneClip(
            report=report,
            frames=frames,
            source=opened,
            sampling=sampling,
            fitter=fitter,
            model=network,
            fusion=fitted,
            options=options,
            devices=devices,
            known=known,
            geometry=geometry,
            out=out,
            saving=saving,
        )
        result = clip.run(windows, unchecked=unchecked)
    report.summary(result, out, network)
    if known.tracks is not None and "tracks" in network.untrained_heads:
        report.line("The track head of this model is untrained: its tracks show that everything runs, no more.")
    if view:
        serve(report, [result], [str(out)])

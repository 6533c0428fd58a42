"""Frames of a video file by their presentation times, upright, decoded one at a time. Does not import jax."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from PIL import Image

from vggtjax.clips.media.arrays import frame_name
from vggtjax.clips.media.colour import Colours, colours_of, rgb_pixels, tags
from vggtjax.clips.media.images import check_not_empty
from vggtjax.clips.media.sampling import Frame, Sampling, before_it
from vggtjax.errors import ClipError, check_regular

if TYPE_CHECKING:
    from types import ModuleType

    from av import VideoCodecContext, VideoFrame, VideoStream
    from av.container import InputContainer
    from av.filter import Graph
    from av.stream import Stream

logger = logging.getLogger(__name__)

# Ends of names, for telling a video from other files.
_SUFFIXES = (
    *(".mp4", ".m4v", ".mov", ".3gp", ".mkv", ".webm", ".avi", ".mpg", ".mpeg"),
    *(".ts", ".mts", ".m2ts", ".wmv", ".flv", ".ogv", ".mxf", ".gif"),
)
# Containers that hold their own video. FFmpeg also reads playlists and text, which can name other files.
_CONTAINERS = "mov,matroska,avi,mpeg,mpegts,asf,flv,ogg,mxf,gif"
_MOST_PIXELS = 2**27  # of one frame; 15360 x 8640 is below it
_ALWAYS_PIXELS, _MOST_PIXELS_A_BYTE = 2**23, 10_000  # of a frame in any file, 3840 x 2160; and by the file's size
_LEAST_DEINTERLACED = 4  # lines and columns; the filter refuses smaller frames
_EXACT_CONTAINERS = frozenset(("mov", "matroska", "avi"))  # their stated length is reliable
_MISSING_END = 0.5  # seconds by which a whole file may end before its stated length


@dataclass(frozen=True)
class VideoFile:
    """A video file; frames are named by their index in it, and times count from its first frame."""

    path: Path
    _said: set[str] = field(default_factory=set, init=False, repr=False, compare=False)  # warnings, each once

    @property
    def name(self) -> str:
        """The file's name."""
        return self.path.stem

    def total(self, sampling: Sampling) -> None:
        """Return None: only decoding tells how many frames there are."""

    def seconds(self) -> float | None:
        """Return the length that the file states, or None where it states none. Raises ClipError as `frames` does."""
        with self._content() as (container, stream):
            if stream.duration is not None and stream.time_base is not None:
                return float(stream.duration * stream.time_base)
            return None if container.duration is None else container.duration / 1e6

    def tags(self) -> dict[str, str]:
        """Return what the file and its video stream say of themselves. Raises ClipError as `frames` does."""
        with self._content() as (container, stream):
            return {**container.metadata, **stream.metadata}

    @contextmanager
    def _content(self) -> Iterator[tuple[InputContainer, VideoStream]]:
        import av
        import av.error

        try:
            with _opened(self.path, av) as container:
                yield container, _video_stream(container, self.path, self._said)
        except (av.error.FFmpegError, OSError, EOFError) as error:
            raise _unreadable(self.path, 0, error) from error

    def frames(self, sampling: Sampling) -> Iterator[Frame]:
        """Yield the frames that `sampling` takes; decoding stops after the last of them.

        Raises ClipError for a file that is not a video or has no video stream, no frame at `start`, or breaks off.
        """
        import av
        import av.error

        rotation, matrix = None, np.eye(2)
        for index, time, (frame, colours) in sampling.select(_timed(self.path, av, self._said)):
            if frame.rotation != rotation:  # asking a frame for its matrix keeps it alive until garbage is collected
                rotation, matrix = frame.rotation, _display_matrix(frame, self.path)
            try:
                pixels = rgb_pixels(frame, colours)
            except (av.error.FFmpegError, ValueError) as error:
                raise _unreadable(self.path, index, error) from error
            yield Frame(frame_name(index), Image.fromarray(upright(pixels, matrix)), time, index=index)


def is_video_name(path: Path) -> bool:
    """Return whether the name ends as that of a video file does."""
    return path.suffix.lower() in _SUFFIXES


def upright(pixels: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return a stored frame [H, W, C] turned and mirrored the way it is to be shown, a view [H, W, C] or [W, H, C].

    Two entries of `matrix` [2, 2] are 0; stored (x, y) is shown at (x, y) @ matrix, y pointing down.
    """
    (a, b), (c, d) = matrix
    across, down = a, d  # x' = a x, y' = d y
    if not a and not d:
        pixels = pixels.swapaxes(0, 1)
        across, down = c, b  # x' = c y, y' = b x
    if across < 0:
        pixels = pixels[:, ::-1]
    return pixels[::-1] if down < 0 else pixels


def _display_matrix(frame: VideoFrame, path: Path) -> np.ndarray:
    """Return the upper left of the frame's 3 x 3 display matrix as -1, 0 and 1; the unit matrix where there is none."""
    data = frame.side_data.get("DISPLAYMATRIX")
    if data is None:
        return np.eye(2)
    matrix = np.frombuffer(data, np.int32).reshape(3, 3)[:2, :2].astype(np.float64)
    lengths = np.linalg.norm(matrix, axis=1, keepdims=True)
    if not lengths.all():  # some files leave it at 0
        return np.eye(2)
    matrix /= lengths
    turned = np.rint(matrix)
    if np.abs(matrix - turned).max() > 0.02 or not np.linalg.det(turned):
        raise ClipError(f"video {path} is to be shown turned by {frame.rotation} degrees; expected a multiple of 90")
    return turned


def _opened(path: Path, av: ModuleType) -> InputContainer:
    """Return the opened file, of one of the `_CONTAINERS` only."""
    check_regular(path, ClipError)
    if path.exists():
        check_not_empty(path)
    options: dict[str, Any] = {"container_options": {"format_whitelist": _CONTAINERS}}
    if int(av.__version__.split(".")[0]) < 19:  # later ones never fail on titles in odd encodings
        options["metadata_errors"] = "replace"
    # An absolute path cannot be taken for a protocol such as "concat:".
    return av.open(str(path.absolute()), **options)


def _timed(path: Path, av: ModuleType, said: set[str]) -> Iterator[tuple[float, tuple[VideoFrame, Colours]]]:
    """Yield (seconds since the first frame, frame and its colours) of every frame of the file's best video stream."""
    count, first = 0, 0.0
    try:
        with _opened(path, av) as container:
            stream = _video_stream(container, path, said)
            container_tags = tags(stream.codec_context)
            for frame in _progressive(_decoded(container, stream), stream, path, said):
                unit = frame.time_base or stream.time_base  # the last frames of a damaged file have none
                if frame.pts is None or unit is None:
                    raise ClipError(f"frame {count} of video {path} has no presentation time; write the video as MP4")
                if frame.width * frame.height > _MOST_PIXELS:
                    raise ClipError(
                        f"video {path} has frames of {frame.width} x {frame.height}; expected at most {_MOST_PIXELS} "
                        f"pixels, make them smaller"
                    )
                time = float(frame.pts * unit)
                if count == 0:
                    first = time
                count += 1
                yield time - first, (frame, _known_colours(frame, container_tags, path, said))
    except (av.error.FFmpegError, OSError, EOFError) as error:
        raise _unreadable(path, count, error) from error


def _known_colours(frame: VideoFrame, container_tags: tuple[int, int, int], path: Path, said: set[str]) -> Colours:
    """Return the colours of a frame and log what is done to them. Raises ClipError for such as cannot be read."""
    colours = colours_of(frame, container_tags)
    if not colours.is_readable:
        raise ClipError(
            f"video {path} has colours in ICtCp or IPT, such as of Dolby Vision's profile 5; expected YCbCr or RGB, "
            "write it anew as SDR"
        )
    if colours.note is not None:
        _say(path, colours.note, said)
    return colours


def _video_stream(container: InputContainer, path: Path, said: set[str]) -> VideoStream:
    from av.stream import Disposition

    stream = cast("VideoStream | None", container.streams.best("video"))
    if stream is None or stream.disposition & Disposition.attached_pic:  # the cover of a piece of music
        raise ClipError(f"{path} has no video stream; expected a whole video file")
    decoder = cast("VideoCodecContext | None", stream.codec_context)
    if decoder is None:
        raise ClipError(f"video {path} has a codec that is not known; write it anew, such as by H.264")
    size = path.stat().st_size
    most = min(_MOST_PIXELS, max(_ALWAYS_PIXELS, _MOST_PIXELS_A_BYTE * size))
    if decoder.width * decoder.height > most:
        shown = f"frames of {decoder.width} x {decoder.height} pixels in {size} bytes"
        raise ClipError(f"video {path} says it has {shown}; expected at most {most} pixels, in a whole file")
    decoder.options = {"max_pixels": str(most)}  # also of sizes that the frames themselves say
    stream.thread_type = "AUTO"
    others = [each for each in container.streams.video if not each.disposition & Disposition.attached_pic]
    if len(others) > 1:
        sizes = ", ".join(f"{each.width} x {each.height}" for each in others)
        _say(path, f"holds {len(others)} videos ({sizes}); that of {stream.width} x {stream.height} is read", said)
    aspect = stream.sample_aspect_ratio
    if aspect not in (None, 0, 1):
        _say(path, f"has pixels of aspect {aspect}; they are taken as square", said)
    return stream


def _say(path: Path, note: str, said: set[str]) -> None:
    """Log what is odd about a video, once."""
    if note not in said:
        said.add(note)
        logger.warning("%s %s", path, note)


def _progressive(frames: Iterator[VideoFrame], stream: VideoStream, path: Path, said: set[str]) -> Iterator[VideoFrame]:
    """Yield frames as they are up to the first interlaced one; from there on those that are lose their combs.

    Each pair of fields becomes one frame, at the time of the first field.
    """
    for frame in frames:
        if frame.interlaced_frame and min(frame.width, frame.height) >= _LEAST_DEINTERLACED:
            _say(path, "is interlaced; its frames are deinterlaced, one for each pair of fields", said)
            yield from _deinterlaced(chain([frame], frames), stream)
            return
        yield frame


def _deinterlaced(frames: Iterator[VideoFrame], stream: VideoStream) -> Iterator[VideoFrame]:
    """Yield the frames with those that are interlaced made whole by FFmpeg's bwdif; it runs a frame behind."""
    from av.filter import Graph

    graph, shape = None, None
    for frame in frames:
        now = (frame.width, frame.height, frame.format.name)
        if graph is None or now != shape:
            if graph is not None:
                yield from _filtered(graph, None)
            graph, shape = Graph(), now
            source = graph.add_buffer(template=stream, width=frame.width, height=frame.height, format=frame.format)
            graph.link_nodes(source, graph.add("bwdif", "mode=send_frame:deint=interlaced"), graph.add("buffersink"))
            graph.configure()
        yield from _filtered(graph, frame)
    if graph is not None:
        yield from _filtered(graph, None)


def _filtered(graph: Graph, frame: VideoFrame | None) -> Iterator[VideoFrame]:
    """Yield what a graph gives after a frame, or after the last one."""
    import av.error

    graph.vpush(frame)
    with suppress(av.error.BlockingIOError, av.error.EOFError):  # it needs more, or has no more
        while True:
            yield graph.vpull()


def _decoded(container: InputContainer, stream: VideoStream) -> Iterator[VideoFrame]:
    """Yield every frame of the stream; raise EOFError where the file ends before its video does."""
    end = 0.0
    # Packets of all streams tell where the file ends if only the length of all together is known, as in Matroska.
    streams: list[Stream] = [stream] if stream.duration is not None else list(container.streams)
    for packet in container.demux(streams):
        if packet.is_corrupt:
            yield from stream.decode(None)  # the decoder runs behind the packets
            raise EOFError("the next packet is damaged or incomplete")
        start = packet.dts if packet.pts is None else packet.pts
        if start is not None:
            end = max(end, float((start + (packet.duration or 0)) * packet.time_base))
        if packet.stream is stream:
            yield from stream.decode(packet)
    expected = _expected_end(container, stream)
    if end < expected - _MISSING_END:
        raise EOFError(f"the file ends at {end:.2f} s of {expected:.2f} s")


def _expected_end(container: InputContainer, stream: VideoStream) -> float:
    """Return the time in seconds at which the packets should end, or 0 where the container does not know."""
    if not _EXACT_CONTAINERS.intersection(container.format.name.split(",")):
        return 0.0
    if stream.duration is not None and stream.time_base is not None:
        return float(((stream.start_time or 0) + stream.duration) * stream.time_base)
    return (container.duration or 0) / 1e6  # Matroska counts it from 0, wherever its first frame is


def _unreadable(path: Path, count: int, error: Exception) -> ClipError:
    reason = getattr(error, "strerror", None) or error
    if count:
        return ClipError(f"video {path} breaks off at frame {count} ({reason}); {before_it(count)}")
    return ClipError(f"cannot read video {path}: {reason}; expected a whole file of a known video format")

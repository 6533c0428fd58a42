"""Run an artefact of `vggtjax export-model`: needs jax and numpy, not vggtjax.

    python artefact/serve.py clip.npy other.npy --out results

Every clip is a file of frames [S, H, W, 3]: uint8, or floating point in [0, 1]. Each becomes NAME.npz with the arrays
that manifest.json lists. In Python, `load("artefact")` returns a function from frames to a dictionary of arrays.

The artefact must be of this version and for the platform that jax uses here, and its files must have the digests of
its manifest; otherwise one sentence says what does not fit, and the exit code is 2. Nothing is unpickled. The program
is compiled when it first runs; with JAX_COMPILATION_CACHE_DIR set to a folder, only once.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import reprlib
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

import jax
import numpy as np

FORMAT, VERSION = "vggtjax-artefact", 1
MANIFEST, PROGRAM, WEIGHTS = "manifest.json", "program.bin", "weights.safetensors"

_DTYPES = {"F32": "float32", "BF16": "bfloat16", "F16": "float16", "I8": "int8", "U16": "uint16"}  # of safetensors
_MOST_BYTES = 1 << 24  # of the manifest, and of the header of the weights
_MOST_LETTERS = 480  # of a message
_MOST_WORD = 200  # letters of a text in the manifest that is used
_MALFORMED = (ArithmeticError, AttributeError, LookupError, MemoryError, RecursionError, TypeError, ValueError)


class ArtefactError(Exception):
    """What does not fit, in one sentence: a printable line of at most _MOST_LETTERS letters."""

    def __str__(self) -> str:
        text = _printable(super().__str__())
        end = _MOST_LETTERS // 3
        return text if len(text) <= _MOST_LETTERS else f"{text[: _MOST_LETTERS - end - 5]} ... {text[-end:]}"


def _printable(text: str) -> str:
    """Return text on one line, for a terminal: names of files may hold control characters."""
    return "".join(c if c.isprintable() else " " if c.isspace() else "?" for c in text)


def load(folder: str | Path) -> Callable[[np.ndarray], dict[str, np.ndarray]]:
    """Return the artefact's function: frames [S, H, W, 3] -> arrays by name. Raises ArtefactError."""
    folder = Path(folder)
    manifest = read_manifest(folder)
    for name in (PROGRAM, WEIGHTS):
        _check_file(folder / name, manifest["files"][name])
    try:
        from jax import export
    except ImportError as error:
        raise ArtefactError(f"jax {jax.__version__} cannot read programs ({error}); install a later one") from error
    lowest = export.minimum_supported_calling_convention_version
    highest = export.maximum_supported_calling_convention_version
    convention, writer = manifest["calling_convention"], f"jax {manifest['jax']}"
    if not lowest <= convention <= highest:
        raise ArtefactError(
            f"{folder} was written by {writer} with calling convention {convention}; jax {jax.__version__} here reads "
            f"{lowest} to {highest}: install {writer}"
        )
    here = {"gpu": ("cuda", "rocm")}.get(jax.default_backend(), (jax.default_backend(),))
    if not set(here) & set(manifest["platforms"]):
        raise ArtefactError(
            f"{folder} is for {' and '.join(manifest['platforms'])}; jax runs on {' or '.join(here)} here: export the "
            f"model for that platform, or set JAX_PLATFORMS"
        )
    try:
        exported = export.deserialize(bytearray((folder / PROGRAM).read_bytes()))
        program = jax.jit(exported.call)
    except Exception as error:  # the file is whole, so this jax does not know what is in it
        raise ArtefactError(
            f"jax {jax.__version__} cannot read the program of {folder}, which {writer} wrote ({_reason(error)}): "
            "install that version"
        ) from error
    weights = jax.device_put(_read_weights(folder / WEIGHTS))
    expected = manifest["inputs"]["images"]

    def run(frames: np.ndarray) -> dict[str, np.ndarray]:
        images = _as_images(frames, expected["shape"])
        try:
            outputs = program(weights, images)
            return {name: np.asarray(outputs[name]) for name in manifest["outputs"]}
        except (ValueError, TypeError, LookupError) as error:  # of jax, before it runs: such as for a GPU of AMD
            raise ArtefactError(f"the program of {folder} cannot run here: {_reason(error)}") from error

    return run


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of an artefact of this version. Raises ArtefactError."""
    path = folder / MANIFEST
    _check_regular(path)
    try:
        with path.open("rb") as file:
            text = file.read(_MOST_BYTES + 1)
        if len(text) > _MOST_BYTES:
            raise ArtefactError(f"{path} has more than {_MOST_BYTES} bytes; copy the artefact again")
        manifest = json.loads(text)
    except OSError as error:
        raise ArtefactError(f"{folder} is not an artefact: {path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise ArtefactError(f"{path} is damaged ({_reason(error)}); copy the artefact again") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ArtefactError(f"{path} is not the manifest of an artefact: its format is not {FORMAT}")
    if manifest.get("version") != VERSION:
        raise ArtefactError(
            f"{folder} has version {reprlib.repr(manifest.get('version'))} of the format; this script reads {VERSION}: "
            "use the serve.py that lies in the artefact, or export the model again"
        )
    try:
        facts = [manifest["jax"], *(manifest["files"][name]["sha256"] for name in (PROGRAM, WEIGHTS))]
        facts += [*manifest["platforms"], *manifest["outputs"]]
        shape = manifest["inputs"]["images"]["shape"]
        whole = all(isinstance(x, str) and len(x) <= _MOST_WORD for x in facts)
        whole &= all(name.isidentifier() for name in manifest["outputs"])  # they become names in an archive
        whole &= not {"file", "allow_pickle"} & set(manifest["outputs"])  # numpy.savez has parameters of these names
        whole &= all(type(x) is int and 0 < x < 2**31 for x in (manifest["calling_convention"], *shape))
        whole &= len(shape) == 4 and shape[3] == 3
    except _MALFORMED:
        whole = False
    if not whole:
        raise ArtefactError(f"{path} is damaged: fields are missing or have wrong types; copy the artefact again")
    return manifest


def _check_regular(path: Path) -> None:
    """Refuse a pipe or a device before it is opened: reading one may never end."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise ArtefactError(f"{path} is a pipe, a socket or a device; expected a file: copy its content into one")


def _reason(error: Exception) -> str:
    """Return the first line of what an exception says, shortened."""
    return (str(error).strip() or type(error).__name__).split("\n")[0][:_MOST_WORD]


def _check_file(path: Path, facts: dict[str, Any]) -> None:
    _check_regular(path)
    try:
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256")
    except OSError as error:
        raise ArtefactError(f"cannot read {path}: {error.strerror}; copy the artefact again") from error
    if digest.hexdigest() != facts["sha256"]:
        raise ArtefactError(f"{path} is damaged: its sha256 is not that of {MANIFEST}; copy the artefact again")


def _read_weights(path: Path) -> dict[str, np.ndarray]:
    """Map the tensors of a safetensors file, whose digest is known to be right."""
    import ml_dtypes  # which jax installs

    size = path.stat().st_size
    try:
        with path.open("rb") as file:
            length = int.from_bytes(file.read(8), "little")
            if length > min(_MOST_BYTES, size - 8):
                raise ValueError(f"a header of {length} bytes")
            header = json.loads(file.read(length))
        header.pop("__metadata__", None)
        content = np.memmap(path, np.uint8, mode="r", offset=8 + length)
        weights, total = {}, 0
        for name, tensor in header.items():
            (start, end), code = tensor["data_offsets"], _DTYPES[tensor["dtype"]]
            dtype = np.dtype(getattr(ml_dtypes, code, code))
            if math.prod(tensor["shape"]) * dtype.itemsize != end - start or not 0 <= start <= end <= len(content):
                raise ValueError(f"the tensor {reprlib.repr(name)} has other offsets than its shape needs")
            weights[name] = content[start:end].view(dtype).reshape(tensor["shape"])
            total += end - start
        if total > len(content):  # on a device they would take as much
            raise ValueError("its tensors overlap")
    except _MALFORMED as error:
        words = f"{type(error).__name__}: {_reason(error)}"
        raise ArtefactError(f"{path} is not a whole file of weights ({words}); export the model again") from error
    return weights


def _as_images(frames: np.ndarray, shape: Sequence[int]) -> np.ndarray:
    """Return frames as float32 in [0, 1]. Raises ArtefactError for another shape, type or range."""
    if list(frames.shape) != list(shape):
        raise ArtefactError(f"the frames have shape {list(frames.shape)}; this artefact takes {list(shape)}")
    if frames.dtype == np.uint8:
        return frames.astype(np.float32) / np.float32(255)
    if not np.issubdtype(frames.dtype, np.floating):
        raise ArtefactError(f"the frames have type {frames.dtype}; expected uint8, or floating point in [0, 1]")
    if not (frames.min() >= 0 and frames.max() <= 1):  # NaN is not, either
        raise ArtefactError("the frames have values that are not in [0, 1]; divide them by 255, or give uint8")
    return frames.astype(np.float32)


def _read_frames(path: Path) -> np.ndarray:
    """Map the frames of a file: their shape is checked before they take memory."""
    _check_regular(path)
    try:
        frames = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # of numpy, zipfile or Python's parser, for whatever a damaged header says
        raise ArtefactError(f"cannot read {path}: {_reason(error)}") from error
    if not isinstance(frames, np.ndarray):
        frames.close()
        raise ArtefactError(f"{path} holds several arrays; expected one array of frames, as numpy.save writes it")
    return frames


def _write_result(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write a file as a whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(suffix=".npz", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        super().error(_printable(message))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code: 0, or 2 for what does not fit."""
    parser = _Parser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("clips", nargs="+", type=Path, help="files of numpy.save: frames [S, H, W, 3]")
    parser.add_argument("--out", type=Path, required=True, help="folder for a file NAME.npz per clip")
    parser.add_argument("--artefact", type=Path, default=Path(__file__).parent, help="its folder; this script's own")
    given = parser.parse_args(arguments)
    try:
        names = [clip.stem for clip in given.clips]
        if len(set(names)) < len(names):
            raise ArtefactError("two clips have the same name; their results would overwrite each other: rename one")
        run = load(given.artefact)
        for clip, name in zip(given.clips, names, strict=True):
            _write_result(given.out / f"{name}.npz", run(_read_frames(clip)))
            sys.stdout.write(f"{_printable(str(given.out / name))}.npz\n")
    except ArtefactError as error:
        message = str(error)
    except OSError as error:
        message = f"cannot write {error.filename or given.out}: {error.strerror or error}"
    except RuntimeError as error:  # jax's own errors are
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        message = "the clip does not fit in the memory of the device; export the model for fewer frames"
    else:
        return 0
    sys.stderr.write(f"serve: {_printable(message)}\n")
    return 2


if __name__ == "__main__":
    sys.exit(main())

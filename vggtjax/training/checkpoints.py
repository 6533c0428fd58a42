"""Checkpoints of a training run: its complete state; an interrupted write leaves the previous checkpoint."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import jax
import orbax.checkpoint as orbax

from vggtjax.errors import CheckpointError, check_regular, one_line
from vggtjax.storage.writing import write_errors
from vggtjax.training.recipe import Recipe
from vggtjax.training.state import TrainingState

KEPT = 2  # newest checkpoints; older ones are removed

_STATE, _RUN = "state", "run"
# Exceptions of orbax, tensorstore and Python's parser for damaged files; jax's own errors are other RuntimeErrors.
_BROKEN = (OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, AssertionError, RecursionError)


class Restored(NamedTuple):
    """The content of a checkpoint: state, recipe, and notes of the run."""

    state: TrainingState
    recipe: Recipe
    notes: Any  # JSON values of a stranger


def latest(folder: str | Path) -> int | None:
    """Return the step of the newest complete checkpoint in `folder`; None without a checkpoint.

    Raises CheckpointError for a folder whose files cannot be read.
    """
    folder = Path(folder)
    if not folder.is_dir():
        return None
    with _explaining(folder), _opened(folder) as manager:
        return manager.latest_step()


def save(folder: str | Path, state: TrainingState, recipe: Recipe, notes: dict[str, Any] | None = None) -> None:
    """Write a checkpoint of a step, unless it exists, and remove all but the newest `KEPT`.

    The folder is made if missing. Recipe and notes, which are JSON values, are written beside the state.
    Raises OutputError if the folder cannot be written or the disk is full.
    """
    folder = Path(folder)
    step = int(state.step)
    with write_errors(folder / str(step)), _opened(folder, create=True) as manager:
        if step in manager.all_steps():
            return
        run = {"recipe": json.loads(recipe.to_json()), "notes": notes or {}}
        items = {_STATE: orbax.args.StandardSave(state), _RUN: orbax.args.JsonSave(run)}
        manager.save(step, args=orbax.args.Composite(**items), force=True)


def restore(folder: str | Path, shapes: TrainingState, recipe: Recipe) -> Restored:
    """Read the newest checkpoint onto the default device.

    `recipe` is that of the resumed run: its phases, learning rate and losses may differ from those of the checkpoint.
    `shapes` are those of its state (`state_shapes`).
    Raises CheckpointError for a missing or unreadable checkpoint, and for a state of other parameters.
    """
    folder = Path(folder)
    if (step := latest(folder)) is None:
        raise CheckpointError(f"{folder} holds no checkpoint of a training run; name the folder of one")
    place = folder / str(step)
    device = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    target = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=device), shapes)
    with _opened(folder) as manager, _explaining(place):
        run = manager.restore(step, args=orbax.args.Composite(**{_RUN: orbax.args.JsonRestore()}))[_RUN]
        written = Recipe.from_json(json.dumps(run["recipe"]))
        for name, old, new in (
            ("model", written.model, recipe.model),
            ("trainable", written.trainable, recipe.trainable),
            ("untrained", set(written.untrained), set(recipe.untrained)),
            ("optimiser.kind", written.optimiser.kind, recipe.optimiser.kind),
        ):
            if old != new:
                raise CheckpointError(
                    f"{place} is a checkpoint of the recipe '{written.name}' with another {name}; choose another "
                    "folder for this run, or resume with that recipe"
                )
        _check_shapes(place, manager.item_metadata(step)[_STATE], shapes)
        items = manager.restore(step, args=orbax.args.Composite(**{_STATE: orbax.args.StandardRestore(target)}))
    return Restored(items[_STATE], written, run.get("notes"))


def _opened(folder: Path, *, create: bool = False) -> orbax.CheckpointManager:
    for path in folder.rglob("*"):  # orbax would open a pipe, and wait
        check_regular(path, CheckpointError)
    options = orbax.CheckpointManagerOptions(
        max_to_keep=KEPT, create=create, cleanup_tmp_directories=create, enable_async_checkpointing=False
    )
    handlers = {_STATE: orbax.StandardCheckpointHandler(), _RUN: orbax.JsonCheckpointHandler()}
    return orbax.CheckpointManager(folder.resolve(), options=options, item_handlers=handlers)


class _FinishingLoop(asyncio.SelectorEventLoop):
    """A loop that ends its reads before it closes: where one fails, orbax leaves the others, which print tracebacks."""

    def close(self) -> None:
        if reads := asyncio.all_tasks(self):
            self.run_until_complete(asyncio.gather(*reads, return_exceptions=True))
        super().close()


@contextmanager
def _explaining(place: Path) -> Iterator[None]:
    """Turn exceptions for damaged files into CheckpointError, with no word on the terminal."""
    new_event_loop, asyncio.new_event_loop = asyncio.new_event_loop, _FinishingLoop  # which orbax calls
    try:
        yield
    except CheckpointError:
        raise
    except _BROKEN as error:
        raise CheckpointError(f"{place} cannot be read as a checkpoint of a run: {one_line(str(error))}") from error
    finally:
        asyncio.new_event_loop = new_event_loop


def _check_shapes(place: Path, metadata: Any, shapes: TrainingState) -> None:
    """Compare leaf by leaf, by path: a stored state has lost the types of its containers."""

    def flat(tree: Any) -> dict[str, tuple[int, ...]]:
        leaves = jax.tree.leaves_with_path(tree)
        return {jax.tree_util.keystr(path, simple=True, separator="."): tuple(leaf.shape) for path, leaf in leaves}

    stored, wanted = flat(metadata), flat(shapes)
    wrong = sorted(name for name in stored.keys() | wanted.keys() if stored.get(name) != wanted.get(name))
    if wrong:
        name = wrong[0]
        raise CheckpointError(
            f"{place} holds the state of another run: {len(wrong)} arrays differ, such as {name}: "
            f"{stored.get(name, 'missing')}, expected {wanted.get(name, 'none')}"
        )

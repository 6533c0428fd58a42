"""Processes that share the clips of a step: loss and gradient of a batch on the cores of a CPU.

Within one process XLA divides every operation among the cores, and small operations not at all. Processes that have a
part of the cores each meet once in a step.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import cache
from multiprocessing.connection import Connection
from threading import Thread
from typing import Any, Self

import jax
import numpy as np
from jaxtyping import Float

from vggtjax.errors import InputError, VggtjaxError, one_line
from vggtjax.network.layers import Params
from vggtjax.storage.cores import core_count
from vggtjax.storage.kept_memory import keep_freed_memory, run_in_calling_thread
from vggtjax.training.optimiser import join, split
from vggtjax.training.recipe import Recipe
from vggtjax.training.state import Metrics, Objective, loss_and_gradient

# Of jax, which workers share with the process that starts them.
_SETTINGS = ("jax_enable_x64", "jax_default_matmul_precision", "jax_compilation_cache_dir")
_SIGNALS = {signal.SIGINT, signal.SIGTERM}

_given: list[Any] = []  # in a worker: the shared memory, and the pickled task


class Workers:
    """Processes that each compute loss and gradient of an equal share of every batch.

    The loss of a batch, and its metrics, must be the means of those of its shares. Leaving the context ends the
    processes.
    """

    def __init__(self, recipe: Recipe, objective: Objective, trained: Params, count: int) -> None:
        """Prepare `count` processes, a number that `check_workers` has accepted; they start with the first batch.

        Raises InputError if the objective is not defined at the top of a module.
        """
        self._recipe, self._count = recipe, count
        moving, frozen = split(trained, recipe)
        shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, np.float32), moving)
        task = _pickled(recipe, objective, jax.device_get(frozen), shapes)
        size = sum(leaf.size for leaf in jax.tree.leaves(shapes))
        context: Any = multiprocessing.get_context("spawn")
        memory = [context.RawArray("f", size) for _ in range(1 + count)]
        self._parameters, *self._gradients = (_Vector(shared, shapes) for shared in memory)
        alive, self._alive = context.Pipe(duplex=False)
        settings = {name: getattr(jax.config, name) for name in _SETTINGS}
        given = (alive, max(core_count() // count, 1), settings, memory, task)
        self._pool = ProcessPoolExecutor(count, context, _begin, given)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._alive.close()
        self._pool.shutdown()

    def loss_and_gradient(self, trained: Params, batch: Any) -> tuple[Metrics, Params]:
        """Return what the function of this name returns for the whole batch.

        Raises:
            VggtjaxError: a process cannot be started, has ended or failed.
            MemoryError: a process found no memory.
        """
        self._parameters.write(split(trained, self._recipe)[0])
        batch = jax.device_get(batch)
        shares = [jax.tree.map(lambda leaf, i=i: np.split(leaf, self._count)[i], batch) for i in range(self._count)]
        try:
            with _signals_later():
                futures = [self._pool.submit(_compute, index, share) for index, share in enumerate(shares)]
            answers = [future.result() for future in futures]
        except BrokenProcessPool:
            raise VggtjaxError(
                "a worker of the training run has ended, perhaps for lack of memory (take fewer workers), or because "
                "a script that trains with workers lacks `if __name__ == '__main__':`; the same command resumes the "
                "run from its last checkpoint"
            ) from None
        except OSError as error:
            raise VggtjaxError(f"a worker of the training run cannot be started: {one_line(str(error))}") from None
        metrics = {name: np.mean([answer[name] for answer in answers], dtype=np.float32) for name in answers[0]}
        total = sum(gradient.values for gradient in self._gradients[1:]) + self._gradients[0].values
        total /= np.float32(self._count)
        return _on_device((metrics, self._gradients[0].like(total)))


def check_workers(recipe: Recipe, count: int) -> None:
    """Raise InputError unless so many workers can share the batches of the recipe on this machine."""
    if count == 1:
        return
    if uneven := [phase.batch for phase in recipe.stages if phase.batch % count]:
        raise InputError(
            f"workers is {count}; expected a divisor of the batch of every phase; one is {uneven[0]} clips"
        )
    if jax.default_backend() != "cpu":
        raise InputError(f"workers is {count}, and jax computes on a {jax.default_backend()}; expected 1, or a CPU")
    if (devices := jax.local_device_count()) > 1:
        raise InputError(f"workers is {count}, and the CPU is split into {devices} devices; expected one of the two")


class _Vector:
    """A tree of parameters in memory that processes share: views of a single vector."""

    def __init__(self, shared: Any, shapes: Params) -> None:
        self._shapes, self._structure = jax.tree.flatten(shapes)
        self.values: Float[np.ndarray, " n"] = np.frombuffer(shared, np.float32)
        self.tree = self.like(self.values)

    def like(self, values: Float[np.ndarray, " n"]) -> Params:
        """Return another vector as a tree of views."""
        ends = np.cumsum([shape.size for shape in self._shapes])[:-1]
        pieces = np.split(values, ends)
        shaped = [piece.reshape(shape.shape) for piece, shape in zip(pieces, self._shapes, strict=True)]
        return jax.tree.unflatten(self._structure, shaped)

    def write(self, tree: Params) -> None:
        """Copy a tree into the vector."""
        jax.tree.map(np.copyto, self.tree, tree)


def _on_device(tree: Any) -> Any:
    """Return a tree with its arrays on the device; a program whose inputs are not there yet runs in another thread."""
    return jax.block_until_ready(jax.device_put(tree))


def _pickled(recipe: Recipe, objective: Objective, frozen: Params, shapes: Params) -> bytes:
    try:
        return pickle.dumps((recipe, objective, frozen, shapes))
    except (pickle.PicklingError, AttributeError, TypeError):
        raise InputError(
            f"the objective {getattr(objective, '__name__', objective)!r} cannot be sent to other processes; "
            "define it at the top of a module, or train with 1 worker"
        ) from None


@contextmanager
def _signals_later() -> Iterator[None]:
    """Hold signals back in this thread, and in a process that starts now."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(alive: Connection, cores: int, settings: dict[str, Any], *given: Any) -> None:
    """Prepare a worker, which ends when the other end of `alive` is closed, or its process has gone."""
    for number in _SIGNALS:  # a terminal and a batch system send them to every process; the run's own decides
        signal.signal(number, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)

    def wait() -> None:
        with suppress(EOFError, OSError):
            alive.recv()
        os._exit(0)

    Thread(target=wait, daemon=True).start()
    os.environ["PJRT_NPROC"] = str(cores)  # threads of XLA, which reads it when it starts
    keep_freed_memory(training=True)
    run_in_calling_thread()
    for name, value in {**settings, "jax_platforms": "cpu"}.items():
        jax.config.update(name, value)
    _given.extend(given)


def _compute(index: int, share: Any) -> Metrics:
    """Return the metrics of a share of the batch; its gradient goes to shared memory."""
    try:
        return _computation()(index, share)
    except Exception as error:  # whatever an objective may raise; not every exception can be sent
        text = f"{type(error).__name__}: {error}"
        if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in text:
            raise MemoryError(text) from error
        raise VggtjaxError(f"a worker of the training run failed: {one_line(text)}") from error


@cache
def _computation() -> Callable[[int, Any], Metrics]:
    memory, task = _given
    recipe, objective, frozen, shapes = pickle.loads(task)  # noqa: S301 (of the process that started this one)
    parameters, *gradients = (_Vector(shared, shapes) for shared in memory)
    frozen = _on_device(frozen)
    program = jax.jit(loss_and_gradient, static_argnums=(2, 3))

    def compute(index: int, share: Any) -> Metrics:
        moving, share = _on_device((parameters.tree, share))
        metrics, found = program(join(moving, frozen), share, recipe, objective)
        gradients[index].write(found)
        return jax.device_get(metrics)

    return compute

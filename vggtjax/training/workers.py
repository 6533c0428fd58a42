"""Processes that share the clips of a step: loss and gradient of a batch on the cores of a CPU.

Within one process XLA divides every operation among the cores, and small operations not at all. Processes that have a
part of the cores each meet once in a step.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from multiprocessing.util import Finalize
from typing import Any, NamedTuple, Self

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

_GOODBYE = 2.0  # seconds for all workers to end by themselves
# Of jax, which workers share with the process that starts them.
_SETTINGS = ("jax_enable_x64", "jax_default_matmul_precision", "jax_compilation_cache_dir")
_SIGNALS = {signal.SIGINT, signal.SIGTERM}


class Workers:
    """Processes that each compute loss and gradient of an equal share of every batch.

    The loss of a batch, and its metrics, must be the means of those of its shares. Leaving the context ends the
    processes.
    """

    def __init__(self, recipe: Recipe, objective: Objective, trained: Params, count: int) -> None:
        """Start `count` processes, a number that `check_workers` has accepted.

        Raises:
            InputError: the objective is not defined at the top of a module.
            VggtjaxError: a process cannot be started.
        """
        self._recipe = recipe
        moving, frozen = split(trained, recipe)
        shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, np.float32), moving)
        task = _pickled(recipe, objective, jax.device_get(frozen), shapes)
        size = sum(leaf.size for leaf in jax.tree.leaves(shapes))
        context: Any = multiprocessing.get_context("spawn")
        parameters, *gradients = (context.RawArray("f", size) for _ in range(1 + count))
        self._parameters = _Vector(parameters, shapes)
        self._gradients = [_Vector(gradient, shapes) for gradient in gradients]
        self._pipes: list[Connection] = []
        self._processes: list[Any] = []
        # Also at the interpreter's end, before multiprocessing waits for its processes.
        self._end = Finalize(self, _end, (self._pipes, self._processes), exitpriority=10)
        settings = {name: getattr(jax.config, name) for name in _SETTINGS}
        cores = max(core_count() // count, 1)
        try:
            for gradient in gradients:
                pipe, other = context.Pipe()
                arguments = (other, parameters, gradient, cores, settings)
                process = context.Process(target=_serve, args=arguments, name="vggtjax-train", daemon=True)
                self._pipes.append(pipe)
                self._processes.append(process)
                with _signals_later():
                    process.start()
                other.close()
            for pipe in self._pipes:
                with suppress(OSError):  # an ended process is noticed below
                    pipe.send_bytes(task)
            for index in range(count):
                self._answer(index)
        except OSError as error:
            self._end()
            raise VggtjaxError(f"a worker of the training run cannot be started: {one_line(str(error))}") from None
        except BaseException:
            self._end()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def loss_and_gradient(self, trained: Params, batch: Any) -> tuple[Metrics, Params]:
        """Return what the function of this name returns for the whole batch.

        Raises:
            VggtjaxError: a process has ended or failed.
            MemoryError: a process found no memory.
        """
        self._parameters.write(split(trained, self._recipe)[0])
        batch, count = jax.device_get(batch), len(self._pipes)
        for index, pipe in enumerate(self._pipes):
            share = jax.tree.map(lambda leaf, i=index: np.split(leaf, count)[i], batch)
            with suppress(OSError):
                pipe.send(share)
        answers = [self._answer(index) for index in range(count)]
        metrics = {name: np.mean([answer[name] for answer in answers], dtype=np.float32) for name in answers[0]}
        total = sum(gradient.values for gradient in self._gradients[1:]) + self._gradients[0].values
        total /= np.float32(count)
        return _on_device((metrics, self._gradients[0].like(total)))

    def _answer(self, index: int) -> Any:
        try:
            answer = self._pipes[index].recv()
        except (EOFError, OSError):
            process = self._processes[index]
            process.join(_GOODBYE)
            code = process.exitcode
            raise VggtjaxError(
                f"a worker of the training run ended with exit code {code}"
                + (", perhaps for lack of memory; take fewer workers" if code == -signal.SIGKILL else "")
                + ("; a script that trains with workers needs `if __name__ == '__main__':`" if code == 1 else "")
                + "; the same command resumes the run from its last checkpoint"
            ) from None
        if not isinstance(answer, _Failure):
            return answer
        if answer.is_memory:
            raise MemoryError(answer.text)
        error = VggtjaxError(f"a worker of the training run failed: {one_line(answer.text)}")
        error.add_note(answer.traceback)
        raise error


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


class _Failure(NamedTuple):
    """What a worker says of an exception."""

    text: str
    traceback: str
    is_memory: bool


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
    from multiprocessing import resource_tracker  # not on Windows

    resource_tracker.ensure_running()  # starts with the first process otherwise, and lets the signals through
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end(pipes: list[Connection], processes: list[Any]) -> None:
    """Close the pipes, upon which the processes end; kill those that compute for long."""
    try:
        for pipe in pipes:
            pipe.close()
        until = time.monotonic() + _GOODBYE
        for process in processes:
            if process.pid is not None:
                process.join(max(until - time.monotonic(), 0))
    finally:
        for process in processes:
            if process.pid is not None and process.exitcode is None:
                process.kill()
                process.join()


def _serve(pipe: Connection, parameters: Any, gradient: Any, cores: int, settings: dict[str, Any]) -> None:
    """Answer every share of a batch with its metrics, and its gradient in shared memory, until the pipe is closed."""
    for number in _SIGNALS:  # a terminal and a batch system send them to every process; the run's own decides
        signal.signal(number, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
    os.environ["PJRT_NPROC"] = str(cores)  # threads of XLA, which reads it when it starts
    keep_freed_memory(training=True)
    run_in_calling_thread()
    for name, value in {**settings, "jax_platforms": "cpu"}.items():
        jax.config.update(name, value)
    compute = None
    while True:
        answer: Any = None
        try:
            message = pipe.recv()
        except (EOFError, OSError):  # the run has ended
            return
        except Exception as error:  # an objective that cannot be imported here
            answer = _failure(error)
        else:
            try:
                if compute is None:
                    compute = _computation(parameters, gradient, *message)
                else:
                    answer = compute(message)
            except Exception as error:  # whatever an objective may raise
                answer = _failure(error)
        with suppress(OSError):
            pipe.send(answer)


def _failure(error: Exception) -> _Failure:
    """Return what is said of the exception that is being handled."""
    is_memory = isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error)
    return _Failure(f"{type(error).__name__}: {error}", traceback.format_exc(), is_memory)


def _computation(parameters: Any, gradient: Any, recipe: Recipe, objective: Objective, frozen: Params, shapes: Params):
    """Return the function from a share of a batch to its metrics; it writes the share's gradient."""
    moving, target, frozen = _Vector(parameters, shapes).tree, _Vector(gradient, shapes), _on_device(frozen)
    program = jax.jit(loss_and_gradient, static_argnums=(2, 3))

    def compute(share: Any) -> Metrics:
        given, share = _on_device((moving, share))
        metrics, found = program(join(given, frozen), share, recipe, objective)
        target.write(found)
        return jax.device_get(metrics)

    return compute

"""One side of the comparison of training steps: a process with the package of one checkout.

Run as a script with the checkout on PYTHONPATH; the arguments are the recipe and the number of workers. Then a line
of JSON on standard input for every answer: {"steps": N} for the mean seconds of render, gradient and update; {"losses":
true} for the losses of the first clips.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import jax

from vggtjax.scenes.textures import load_textures
from vggtjax.training.data import make_batch
from vggtjax.training.devices import placement
from vggtjax.training.objective import init_probes, objective
from vggtjax.training.recipe import Recipe, read_recipe
from vggtjax.training.state import apply_gradient, initial_state, loss_and_gradient


def main() -> None:
    """Answer every line of standard input."""
    settle_memory()
    recipe = read_recipe(Path(sys.argv[1]))
    phase = recipe.stages[0]
    where = placement(recipe)

    def start():
        return jax.device_put(initial_state(recipe, init_probes(recipe.seed, recipe.model)), where.whole)

    state = start()
    textures = jax.device_put(load_textures("training"), where.whole)
    render = jax.jit(make_batch, static_argnums=(2, 3), out_shardings=where.by_clip)
    gradient_of = jax.jit(loss_and_gradient, static_argnums=(2, 3))
    if (count := int(sys.argv[2])) > 1:
        gradient_of = shared(recipe, state.trained, count)
    update = jax.jit(apply_gradient, static_argnums=3, donate_argnums=0)

    def draw(number: int):
        return render(jax.random.key(number), textures, phase, phase.frames[0])

    for line in sys.stdin:
        task = json.loads(line)
        if task.get("losses"):
            metrics, _ = gradient_of(start().trained, draw(0), recipe, objective)
            found = {name: float(value) for name, value in metrics.items() if name.startswith("loss")}
            answer({"losses": found})
            continue
        times = dict.fromkeys(("render", "gradient", "update"), 0.0)
        for number in range(task["steps"]):
            began = time.perf_counter()
            batch = jax.block_until_ready(draw(number))
            drawn = time.perf_counter()
            metrics, gradient = jax.block_until_ready(gradient_of(state.trained, batch, recipe, objective))
            done = time.perf_counter()
            state, metrics = jax.block_until_ready(update(state, gradient, metrics, recipe))
            times["render"] += drawn - began
            times["gradient"] += done - drawn
            times["update"] += time.perf_counter() - done
        answer({name: value / task["steps"] for name, value in times.items()})


def settle_memory() -> None:
    """Set the process up as the checkout's own `vggtjax train` does."""
    for name in ("vggtjax.storage.kept_memory", "vggtjax.commands.process"):  # the second in older checkouts
        with suppress(ImportError):
            process: Any = import_module(name)
            if hasattr(process, "run_in_calling_thread"):
                process.keep_freed_memory(training=True)
                process.run_in_calling_thread()
                return
            if hasattr(process, "keep_freed_memory"):
                process.keep_freed_memory()
                return


def shared(recipe: Recipe, trained: Any, count: int) -> Callable[..., Any]:
    """Return the function for loss and gradient whose clips `count` processes share."""
    from vggtjax.training.objective import with_counts  # older checkouts have neither
    from vggtjax.training.workers import Workers

    workers, prepare = Workers(recipe, objective, trained, count), jax.jit(with_counts, static_argnums=1)
    return lambda trained, batch, *_: workers.loss_and_gradient(trained, prepare(batch, recipe.model))


def answer(values: dict[str, Any]) -> None:
    """Write a line of JSON."""
    sys.stdout.write(json.dumps(values) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()

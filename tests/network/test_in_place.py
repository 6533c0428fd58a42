"""What is changed in some layers only: values and gradients beside a conditional."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vggtjax.network.kernels.in_place import added_if, replaced_if


@pytest.mark.parametrize("adds", [False, True])
@pytest.mark.parametrize("flag", [False, True])
def test_values_and_gradients(flag, adds):
    """By what it keeps, by its input and by an array that the function closes over."""

    def loss(change, old, x, scale):
        new = change(jnp.asarray(flag), old, lambda x, times: {"a": times * scale * x**2}, x, jnp.int32(3))
        return (new["a"] * jnp.arange(3.0)).sum()

    def conditional(flag, old, function, *x):
        return jax.lax.cond(flag, lambda: {"a": function(*x)["a"] + (old["a"] if adds else 0)}, lambda: old)

    inputs = ({"a": jnp.ones(3)}, jnp.array([1.0, 2.0, 3.0]), jnp.float32(2))
    change = added_if if adds else replaced_if
    made, wanted = (
        jax.jit(jax.value_and_grad(lambda *xs, f=f: loss(f, *xs), (0, 1, 2)))(*inputs) for f in (change, conditional)
    )
    assert jax.tree.all(jax.tree.map(np.array_equal, made, wanted))


def copies(new):
    """Return whether a loop that replaces its state by `new` in some steps copies it."""

    def run(state, flags):
        return jax.lax.scan(lambda old, flag: (replaced_if(flag, old, lambda: new(old)), None), state, flags)[0]

    text = jax.jit(run, donate_argnums=0).lower(jnp.ones(4096), jnp.zeros(3, bool)).compile().as_text()
    return re.search(r"f32\[4096\]\S* copy\(", str(text)) is not None


def test_what_is_kept_is_not_copied():
    assert not copies(lambda old: jnp.arange(4096.0))
    assert copies(jnp.sin)  # what is computed from the old value needs both


def test_a_function_that_is_left_out_is_not_computed():
    """XLA moves what does not change in a loop out of it, in front of a loop of no step too."""
    x, flag = jnp.ones((64, 64)), jnp.asarray(False)
    for change in (replaced_if, added_if):
        run = jax.jit(lambda flag, x, change=change: change(flag, x, lambda y: y @ x, x))
        text = str(run.lower(flag, x).compile().as_text())
        entry = text[text.index("ENTRY") :]
        assert "dot_general" in text
        assert "dot_general" not in entry


def test_in_a_scan_with_remat_under_vmap():
    """Gradients with remat and under vmap, by an array that the function reads."""

    def loss(change, scale, x):
        def step(total, flag):
            return change(flag, total, lambda x: jnp.sin(scale * x), x), None

        step = jax.checkpoint(step)
        return jax.lax.scan(step, jnp.zeros(3), jnp.array([True, False, True]))[0].sum()

    def conditional(flag, old, function, x):
        return jax.lax.cond(flag, lambda: old + function(x), lambda: old)

    x = jnp.arange(6.0).reshape(2, 3)
    made, wanted = (
        jax.vmap(jax.grad(lambda scale, x, f=f: loss(f, scale, x), (0, 1)), (None, 0))(jnp.float32(2), x)
        for f in (added_if, conditional)
    )
    assert jax.tree.all(jax.tree.map(lambda a, b: np.allclose(a, b, atol=1e-6), made, wanted))

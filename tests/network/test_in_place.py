"""What is changed in some layers only: values and gradients beside a conditional."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vggtjax.network.in_place import added_if, replaced_if


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


def test_what_is_kept_is_not_copied():
    def step(kept, flag):
        return replaced_if(flag, kept, lambda: jnp.zeros_like(kept)), None

    flags = jnp.zeros(3, bool)
    text = (
        jax.jit(lambda x: jax.lax.scan(step, x, flags)[0], donate_argnums=0).lower(jnp.ones(4096)).compile().as_text()
    )
    assert "conditional" not in str(text)

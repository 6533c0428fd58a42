"""The platform that jax computes on."""

from __future__ import annotations

from vggtjax.errors import InputError, one_line


def backend() -> str:
    """Return the platform that jax computes on: "cpu", "gpu" or "tpu".

    Raises InputError where jax cannot start the platforms that JAX_PLATFORMS names.
    """
    import jax  # it takes a second, and a command line that is refused needs none

    try:
        return jax.default_backend()
    except (RuntimeError, AssertionError) as error:
        named = jax.config.jax_platforms  # type: ignore[attr-defined]
        reason = f" ({one_line(str(error), 160)})" if str(error) else ""
        raise InputError(
            f"jax cannot start on JAX_PLATFORMS={named or ''}{reason}; unset it, so that jax takes what is there, or "
            "install jax for it, such as jax[cuda12]"
        ) from error

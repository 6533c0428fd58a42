"""The frames of the clips, wherever they are: all here, or in equal shares on the devices of a mesh."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Int

AXIS = "frames"  # of the mesh
REPLICATED = PartitionSpec()  # on every device
BY_FRAME = PartitionSpec(None, AXIS)  # arrays [B, S, ...]

_Tree = TypeVar("_Tree")
_Parameters = ParamSpec("_Parameters")


@dataclass(frozen=True)
class Frames:
    """Where the frames of a batch of clips are; static under jit.

    Without a mesh all frames are here, and every method below is the identity. With a mesh the methods run inside
    `on_devices`, where device i holds frames i S to (i + 1) S - 1 and S is its own number of frames: the network runs
    there, on its share. What comes after a pass reads all frames, on every device (`whole`).

    Attributes:
        mesh: devices along an axis named "frames"; None for frames that are all here.
        count: frames of each clip on all devices together; the frames after them make the shares equal, and do not
            change them. None: all. Without a mesh, only `whole` reads it.
    """

    mesh: Mesh | None = None
    count: int | None = None

    @property
    def devices(self) -> int:
        """The number of devices along the axis of frames."""
        return 1 if self.mesh is None else self.mesh.shape[AXIS]

    def on_devices(self, function: Callable[_Parameters, _Tree], *specs: Any) -> Callable[_Parameters, _Tree]:
        """Return a function of whole arrays [B, S, ...] that runs `function` on the share of each device.

        `specs` say where its positional arguments are, REPLICATED or BY_FRAME; the outputs are by frame. The gradient
        by an argument that is REPLICATED is summed over the devices at the end, not in every loop and conditional that
        reads it.
        """
        return function if self.mesh is None else OnDevices(function, self.mesh, specs)

    def sharding(self, spec: PartitionSpec) -> NamedSharding | None:
        """Return where an array with this spec is; None without a mesh."""
        return None if self.mesh is None else NamedSharding(self.mesh, spec)

    def first(self, S: int) -> int | Int[Array, ""]:
        """Return the number of the first frame of the S frames here."""
        return 0 if self.mesh is None else jax.lax.axis_index(AXIS) * S

    def numbers(self, S: int) -> Int[np.ndarray, " S"] | Int[Array, " S"]:
        """Return the numbers of the S frames here."""
        return np.arange(S) if self.mesh is None else self.first(S) + jnp.arange(S)

    def total(self, S: int) -> int:
        """Return the number of frames on all devices, where S are here."""
        return S * self.devices

    def counted(self, S: int) -> int:
        """Return the number of frames on all devices, where S are here, without those that make the shares equal."""
        return self.total(S) if self.mesh is None or self.count is None else self.count

    def are_real(self, frame_count: Int[Array, " B"] | None, B: int, S: int) -> Bool[Array, "B S"] | None:
        """Return which of the S frames here are real: before `count`, and `frame_count` of their clip; None: all."""
        if self.counted(S) < self.total(S):
            counts = jnp.full(B, self.counted(S)) if frame_count is None else jnp.minimum(frame_count, self.counted(S))
        elif frame_count is None:
            return None
        else:
            counts = frame_count
        return jnp.asarray(self.numbers(S))[None] < counts[:, None]

    def whole(self, tree: _Tree) -> _Tree:
        """Return whole arrays [B, S, ...] on every device, without frames after `count`; outside of `on_devices`."""
        if (everywhere := self.sharding(REPLICATED)) is not None:
            tree = jax.lax.with_sharding_constraint(tree, everywhere)
        return tree if self.count is None else jax.tree.map(lambda x: x[:, : self.count], tree)

    def gather(self, x: Array, axis: int = 1) -> Array:
        """Return the frames of all devices, along `axis`."""
        return x if self.mesh is None else jax.lax.all_gather(x, AXIS, axis=axis, tiled=True)

    def share(self, x: Array, S: int, axis: int = 1) -> Array:
        """Return the S frames here of an array with the frames of all devices along `axis`."""
        if self.mesh is None:
            return x
        return jax.lax.dynamic_slice_in_dim(x, self.first(S), S, axis)

    def around(self, x: Array, reach: int, axis: int = 1) -> tuple[Array, int | Int[Array, ""]]:
        """Return the frames up to `reach` before and after those here, and perhaps more; and the first one's number.

        There are zeros where the number is below 0, or beyond the last frame.
        """
        if self.mesh is None:
            return x, 0
        S, devices = x.shape[axis], self.devices
        shares = -(-reach // S)  # of neighbours, on either side
        if 2 * shares + 1 >= devices:
            return self.gather(x, axis), 0
        parts = []
        for shift in range(-shares, shares + 1):
            pairs = [(i + shift, i) for i in range(devices) if 0 <= i + shift < devices]
            parts.append(jax.lax.ppermute(x, AXIS, pairs) if shift else x)
        return jnp.concatenate(parts, axis), self.first(S) - shares * S

    def any(self, x: Bool[Array, ""]) -> Bool[Array, ""]:
        """Return whether x is true on any device."""
        return x if self.mesh is None else jax.lax.pmax(x.astype(jnp.int32), AXIS) > 0

    def after(self, x: Array, earlier: Any) -> Array:
        """Return x. On a CPU it is not known before `earlier`, arrays that are computed from frames, is.

        x is the flag of a conditional, or what a loop starts from. XLA's runtime for CPUs can mix up communications of
        two conditionals or loops that run at the same time. Other platforms keep them apart, and waiting takes time.
        """
        if not self._needs_order:
            return x
        # The last number is a patch's: those of camera tokens are constants in the gradients of cues.
        lasts = [leaf.ravel()[-1].astype(jnp.float32) for leaf in jax.tree.leaves(jax.lax.stop_gradient(earlier))]
        bits = jax.lax.bitcast_convert_type(jnp.stack(lasts), jnp.uint32).max()
        # XLA removes an optimisation barrier before it runs the program, and does not find out that this is true.
        return jnp.where((bits | 1) != 0, x, jnp.zeros_like(x))

    def in_order(self, x: Array, later: _Tree) -> tuple[Array, _Tree]:
        """Return x and `later`. On a CPU the gradient by x is not known before the gradients by `later` are."""
        return _in_order(self, x, later) if self._needs_order else (x, later)

    @property
    def _needs_order(self) -> bool:
        return self.mesh is not None and self.mesh.devices.flat[0].platform == "cpu"

    def varying(self, x: _Tree) -> _Tree:
        """Return arrays that are equal on all devices with the type of arrays that differ, for the start of a loop."""
        return x if self.mesh is None else jax.tree.map(lambda leaf: jax.lax.pcast(leaf, AXIS, to="varying"), x)


@dataclass(frozen=True)
class OnDevices(Generic[_Parameters, _Tree]):
    """A function that runs on the share of each device; equal ones share compiled programs."""

    function: Callable[_Parameters, _Tree]
    mesh: Mesh
    specs: tuple[Any, ...]

    def __call__(self, *arguments: _Parameters.args, **options: _Parameters.kwargs) -> _Tree:
        """Return what the function makes of the shares, by frame."""

        function: Callable[..., _Tree] = self.function

        def share(*arguments: Any) -> _Tree:
            pairs = zip(self.specs, arguments, strict=True)
            varying = Frames(self.mesh).varying
            return function(*(varying(x) if spec == REPLICATED else x for spec, x in pairs), **options)

        return jax.shard_map(share, mesh=self.mesh, in_specs=self.specs, out_specs=BY_FRAME)(*arguments)


def with_frames(tree: _Tree, S: int) -> _Tree:
    """Return arrays [B, s, ...] with zeros after their frames, S in all."""
    return jax.tree.map(lambda x: jnp.pad(x, ((0, 0), (0, S - x.shape[1]), *((0, 0),) * (x.ndim - 2))), tree)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _in_order(frames: Frames, x: Array, later: Any) -> tuple[Array, Any]:
    return x, later


def _in_order_forward(frames: Frames, x: Array, later: Any) -> tuple[tuple[Array, Any], None]:
    return (x, later), None


def _in_order_backward(frames: Frames, _: None, gradients: tuple[Array, Any]) -> tuple[Array, Any]:
    by_x, by_later = gradients
    return frames.after(by_x, by_later), by_later


_in_order.defvjp(_in_order_forward, _in_order_backward)

"""PyTorch checkpoints of VGGT -> checkpoints of vggtjax."""

import lazy_loader

# Names and their modules stand in __init__.pyi: reading PyTorch's files needs no jax.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

"""Generated dynamic scenes with exact truth: a ray-casting renderer in pure JAX functions."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

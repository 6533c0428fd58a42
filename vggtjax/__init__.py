"""4DVGGT-D in JAX: cameras, depth, dynamic masks and a 4-D point cloud from a monocular video of a moving world."""

import lazy_loader

from vggtjax.storage.load_order import load_in_order

load_in_order()

__version__ = "0.1.0"

# Names and their modules stand in __init__.pyi; each is imported when it is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

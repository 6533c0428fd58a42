"""Metrics, data sets, evaluations of methods on them, and the ladder of methods."""

import lazy_loader

# __init__.pyi lists the names; each module is imported at the first use of its names.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

"""Learned fusion: a family of rules with the paper's rule as its default, soft masks, objectives and fits."""

import lazy_loader

# Names and their modules stand in __init__.pyi; each is imported when it is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

"""Foreign checkpoints -> parameter trees of vggtjax."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__, submod_attrs={"torch_to_flax": ["convert", "convert_state_dict"]}
)

"""Foreign checkpoints -> parameter trees of vggtjax."""

from converters.torch_to_flax import convert, convert_state_dict

__all__ = ["convert", "convert_state_dict"]

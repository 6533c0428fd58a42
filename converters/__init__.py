"""PyTorch checkpoints of VGGT -> checkpoints of vggtjax."""

from converters.torch_to_flax import Conversion, convert, convert_state_dict

__all__ = ["Conversion", "convert", "convert_state_dict"]

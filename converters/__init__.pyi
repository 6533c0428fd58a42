from .torch_to_flax import Conversion as Conversion
from .torch_to_flax import convert as convert
from .torch_to_flax import convert_state_dict as convert_state_dict

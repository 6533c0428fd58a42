from .backbone import encode as encode
from .config import Cue as Cue
from .config import MotionConfig as MotionConfig
from .config import VGGTConfig as VGGTConfig
from .config import vggt_1b as vggt_1b
from .model import Predictions as Predictions
from .model import forward as forward
from .model import init_params as init_params
from .pose import decode_pose as decode_pose
from .pose import encode_pose as encode_pose

__version__: str

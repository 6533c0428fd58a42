from .checkpoint import Model as Model
from .checkpoint import load_model as load_model
from .clips.clip import Clip as Clip
from .clips.clip import load_clip as load_clip
from .config import Cue as Cue
from .config import MotionConfig as MotionConfig
from .config import VGGTConfig as VGGTConfig
from .config import vggt_1b as vggt_1b
from .errors import VggtjaxError as VggtjaxError
from .fusion import fuse_depth as fuse_depth
from .methods import METHODS as METHODS
from .network.backbone import encode as encode
from .network.model import Predictions as Predictions
from .network.model import forward as forward
from .network.model import init_params as init_params
from .network.pose import decode_pose as decode_pose
from .network.pose import encode_pose as encode_pose
from .passes import Assembly as Assembly
from .passes import Passes as Passes
from .passes import assemble as assemble
from .passes import motion_saliency as motion_saliency
from .passes import run_passes as run_passes
from .pipeline import infer as infer
from .pipeline import reconstruct as reconstruct
from .results.reconstruction import Reconstruction as Reconstruction

__version__: str

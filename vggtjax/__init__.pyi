from .clips.clip import load_clip as load_clip
from .config import VGGTConfig as VGGTConfig
from .method.algorithm import Clips as Clips
from .method.algorithm import run_method as run_method
from .method.algorithm import run_passes as run_passes
from .method.assembly import assemble as assemble
from .method.fusion.file import load_fusion as load_fusion
from .method.fusion.rule import fuse_depth as fuse_depth
from .network.backbone import encode as encode
from .network.heads.pose import decode_pose as decode_pose
from .network.model import forward as forward
from .network.model import init_params as init_params
from .network.precision import Compute as Compute
from .network.suppression import Suppression as Suppression
from .options import METHODS as METHODS
from .options import Options as Options
from .pipeline.batch.many import reconstruct_many as reconstruct_many
from .pipeline.infer import infer as infer
from .pipeline.pretrained.load import load_model as load_model
from .pipeline.run import reconstruct as reconstruct
from .pipeline.windows.extend import extend as extend
from .pipeline.windows.plan import Windows as Windows
from .pipeline.windows.run import reconstruct_long as reconstruct_long
from .results.reconstruction import Reconstruction as Reconstruction
from .storage.cache import enable_compilation_cache as enable_compilation_cache

__version__: str

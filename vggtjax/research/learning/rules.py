"""The fusion rules of `vggtjax.method` as names of this package."""

from vggtjax.method.fusion.family import PARTS as PARTS
from vggtjax.method.fusion.family import Fused as Fused
from vggtjax.method.fusion.family import Observations as Observations
from vggtjax.method.fusion.family import fuse as fuse
from vggtjax.method.fusion.family import paper_rule as paper_rule
from vggtjax.method.fusion.family import parse_family as parse_family
from vggtjax.method.fusion.file import load_fusion as load_fusion
from vggtjax.method.fusion.file import save_fusion as save_fusion
from vggtjax.method.fusion.inputs import observe as observe
from vggtjax.method.soft_mask import SoftMasking as SoftMasking
from vggtjax.method.soft_mask import soft_masking as soft_masking

"""The fusion rules of `vggtjax.method` as names of this package."""

from vggtjax.method.fusion_file import load_fusion as load_fusion
from vggtjax.method.fusion_file import save_fusion as save_fusion
from vggtjax.method.fusion_inputs import observe as observe
from vggtjax.method.fusion_rule import PARTS as PARTS
from vggtjax.method.fusion_rule import Fused as Fused
from vggtjax.method.fusion_rule import Observations as Observations
from vggtjax.method.fusion_rule import fuse as fuse
from vggtjax.method.fusion_rule import identity as identity
from vggtjax.method.fusion_rule import parse_family as parse_family

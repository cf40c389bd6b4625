"""Hidden volumes from captures around a corner: linear operators with exact adjoints. Torch only, never Mitsuba."""

from torchtransient.reconstruction.capture_roots import StabilisedRoot as StabilisedRoot
from torchtransient.reconstruction.capture_roots import stabilised_root as stabilised_root
from torchtransient.reconstruction.diffusion import DiffusionDeconvolution as DiffusionDeconvolution
from torchtransient.reconstruction.directional_lct import DirectionalLCT as DirectionalLCT
from torchtransient.reconstruction.directional_lct import directional_lct as directional_lct
from torchtransient.reconstruction.fk import FK as FK
from torchtransient.reconstruction.fk import fk as fk
from torchtransient.reconstruction.lct import LCT as LCT
from torchtransient.reconstruction.lct import lct as lct
from torchtransient.reconstruction.linear import LinearOperator as LinearOperator
from torchtransient.reconstruction.planar_scan import PlanarScan as PlanarScan

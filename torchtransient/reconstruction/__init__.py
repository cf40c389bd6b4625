"""Hidden volumes from captures around a corner: linear operators with exact adjoints. Torch only, never Mitsuba."""

from torchtransient.reconstruction.linear import LinearOperator as LinearOperator
from torchtransient.reconstruction.planar_scan import PlanarScan as PlanarScan

"""Hidden volumes from captures around a corner: linear operators with exact adjoints. Torch only, never Mitsuba."""

from torchtransient.reconstruction.backprojection import Backprojection as Backprojection
from torchtransient.reconstruction.backprojection import backproject as backproject
from torchtransient.reconstruction.cameras import ConfocalCamera as ConfocalCamera
from torchtransient.reconstruction.cameras import DirectLight as DirectLight
from torchtransient.reconstruction.cameras import TransientCamera as TransientCamera
from torchtransient.reconstruction.filtered_backprojection import FilteredBackprojection as FilteredBackprojection
from torchtransient.reconstruction.filtered_backprojection import filtered_backproject as filtered_backproject
from torchtransient.reconstruction.filters import LaplacianFilter as LaplacianFilter
from torchtransient.reconstruction.filters import PhasorFilter as PhasorFilter
from torchtransient.reconstruction.linear import LinearOperator as LinearOperator
from torchtransient.reconstruction.phasor_field import PhasorField as PhasorField
from torchtransient.reconstruction.phasor_field import phasor_image as phasor_image
from torchtransient.reconstruction.planar_scan import PlanarScan as PlanarScan
from torchtransient.reconstruction.surfaces import DepthMap as DepthMap
from torchtransient.reconstruction.surfaces import depth_map as depth_map
from torchtransient.reconstruction.surfaces import normals_from_depth as normals_from_depth
from torchtransient.reconstruction.surfaces import normals_from_volume as normals_from_volume
from torchtransient.reconstruction.surfaces import soft_depth as soft_depth
from torchtransient.reconstruction.voxels import VoxelGrid as VoxelGrid

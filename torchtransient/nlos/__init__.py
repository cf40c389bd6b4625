"""Around the corner: scans of a relay wall, and captures of objects that laser and sensor cannot see directly.

- `Wall`: the relay wall, `Wall.plane(...)`, `Wall.mesh(...)` or `Wall.of(...)` of a description
- `Scan`: which of its points are lit and seen, `Scan.grid(...)` or `Scan.points(...)`
- `Capture`: the measurement, tensors with their scan and axis
- `simulate`: the capture of hidden things by a scan, or of a complete scene; whole, or in parts that a file keeps
- `forecast`: the memory and time that `simulate` would take, and the estimators that it uses
- `CaptureRenderer`: captures as a differentiable layer
- `capture_scene`: the scene dictionary of hidden things and a scan
- `read_setup`: the arguments of `simulate` in a YAML, y-tal or XML file
- `read_capture`, `write_capture`, or `Capture.read` and `capture.write`: on disk, of any known layout
- `FK`, `fk`: hidden volumes from confocal captures by f-k migration; this one and those below are linear operators,
  and functions of a capture
- `MidpointFK`, `midpoint_fk`: the same from single and exhaustive captures, approximately
- `LCT`, `lct`: the light-cone transform with its Wiener inverse
- `DirectionalLCT`, `directional_lct`: the same with normals
- `DiffusionDeconvolution`: confocal captures through turbid matter, and without it
- `stabilized_root`: roots of light, as f-k takes them, with a slope at empty bins
- `LinearOperator`: base class of all these operators
- `PlanarScan`: a regular grid of a flat wall, which transforms take in place of a scan
- `subtract_legs`: a capture without the first and the last leg of its light
- `VoxelGrid`: positions of the voxels of a hidden volume
- `Backprojection`, `backproject`: linear operator between such a volume and captures of any kind, and of one capture
- `FilteredBackprojection`, `filtered_backproject`: the same behind a filter in time
- `PhasorFilter`, `LaplacianFilter`: such filters
- `PhasorField`, `phasor_image`: waves of a band of frequencies, from plane to plane
- `DirectLight`, `ConfocalCamera`: virtual cameras of phasor fields
- `TransientCamera`: one that sees light travel
- `depth_map`: depths of the surfaces in a reconstructed volume
- `DepthMap`: depths, confidences and the mask of pixels with a surface
- `reconstruct`: the volume that one of these methods finds in a capture
- `choose_method`: the method that suits a capture, and the reason
- `default_grid`: voxels before the wall of a capture
- `sum_bins`, `without_slab`: captures of fewer bins; without the foam before them
- `HiddenVolume`: result of `reconstruct`, a record of tensors as captures are
- `normals_of`: its unit normals, of methods that find them
- `read_volume`, `write_volume`: such volumes on disk

Hidden shapes: `torchtransient.scenes.nlos_*`, `scenes.triangle_mesh`. Pictures: `torchtransient.vis`. The guide is
docs/nlos.md.
"""

from torchtransient.capture import Capture as Capture
from torchtransient.capture import Scan as Scan
from torchtransient.capture import Wall as Wall
from torchtransient.files.captures.formats import read_capture as read_capture
from torchtransient.files.captures.formats import write_capture as write_capture
from torchtransient.files.volume_file import read_volume as read_volume
from torchtransient.files.volume_file import write_volume as write_volume
from torchtransient.nlos.methods import choose_method as choose_method
from torchtransient.nlos.reconstruct import default_grid as default_grid
from torchtransient.nlos.reconstruct import normals_of as normals_of
from torchtransient.nlos.reconstruct import reconstruct as reconstruct
from torchtransient.nlos.reconstruct import sum_bins as sum_bins
from torchtransient.nlos.reconstruct import without_slab as without_slab
from torchtransient.nlos.renderer import CaptureRenderer as CaptureRenderer
from torchtransient.nlos.scene import capture_scene as capture_scene
from torchtransient.nlos.setup_files import read_setup as read_setup
from torchtransient.nlos.simulation import forecast as forecast
from torchtransient.nlos.simulation import simulate as simulate
from torchtransient.reconstruction import FK as FK
from torchtransient.reconstruction import LCT as LCT
from torchtransient.reconstruction import Backprojection as Backprojection
from torchtransient.reconstruction import ConfocalCamera as ConfocalCamera
from torchtransient.reconstruction import DepthMap as DepthMap
from torchtransient.reconstruction import DiffusionDeconvolution as DiffusionDeconvolution
from torchtransient.reconstruction import DirectionalLCT as DirectionalLCT
from torchtransient.reconstruction import DirectLight as DirectLight
from torchtransient.reconstruction import FilteredBackprojection as FilteredBackprojection
from torchtransient.reconstruction import HiddenVolume as HiddenVolume
from torchtransient.reconstruction import LaplacianFilter as LaplacianFilter
from torchtransient.reconstruction import LinearOperator as LinearOperator
from torchtransient.reconstruction import MidpointFK as MidpointFK
from torchtransient.reconstruction import PhasorField as PhasorField
from torchtransient.reconstruction import PhasorFilter as PhasorFilter
from torchtransient.reconstruction import PlanarScan as PlanarScan
from torchtransient.reconstruction import TransientCamera as TransientCamera
from torchtransient.reconstruction import VoxelGrid as VoxelGrid
from torchtransient.reconstruction import backproject as backproject
from torchtransient.reconstruction import depth_map as depth_map
from torchtransient.reconstruction import directional_lct as directional_lct
from torchtransient.reconstruction import filtered_backproject as filtered_backproject
from torchtransient.reconstruction import fk as fk
from torchtransient.reconstruction import lct as lct
from torchtransient.reconstruction import midpoint_fk as midpoint_fk
from torchtransient.reconstruction import phasor_image as phasor_image
from torchtransient.reconstruction import stabilized_root as stabilized_root
from torchtransient.reconstruction import subtract_legs as subtract_legs

"""Pictures and videos of transients: `tt.vis`.

Functions take tensors or arrays (C, T, H, W), a RenderOutput, or the path of a result file; they return an RGB array or
a matplotlib figure and write a file when they are given a path. docs/pictures.md shows one of each.
"""

from torchtransient.vis.arrival import peak_time_picture as peak_time_picture
from torchtransient.vis.arrival import rainbow as rainbow
from torchtransient.vis.colour_maps import cyclic as cyclic
from torchtransient.vis.colour_maps import cyclic_map as cyclic_map
from torchtransient.vis.colour_maps import rainbow_map as rainbow_map
from torchtransient.vis.contact_sheet import Cell as Cell
from torchtransient.vis.contact_sheet import contact_sheet as contact_sheet
from torchtransient.vis.fit_monitor import FitMonitor as FitMonitor
from torchtransient.vis.gradients import gradient_picture as gradient_picture
from torchtransient.vis.overview import light_curve as light_curve
from torchtransient.vis.overview import median_pixel as median_pixel
from torchtransient.vis.overview import peak_time as peak_time
from torchtransient.vis.overview import plot_overview as plot_overview
from torchtransient.vis.phasors import domain_colors as domain_colors
from torchtransient.vis.phasors import phasor_picture as phasor_picture
from torchtransient.vis.phasors import phasor_video as phasor_video
from torchtransient.vis.polarization import polarization_picture as polarization_picture
from torchtransient.vis.rates import range_doppler as range_doppler
from torchtransient.vis.rates import speed_picture as speed_picture
from torchtransient.vis.scans import peak_time_map as peak_time_map
from torchtransient.vis.scans import scan_layout as scan_layout
from torchtransient.vis.scans import transients_grid as transients_grid
from torchtransient.vis.scans import wall_frames as wall_frames
from torchtransient.vis.scans import wall_video as wall_video
from torchtransient.vis.shape_fit import plot_shape_fit as plot_shape_fit
from torchtransient.vis.slices import frame_grid as frame_grid
from torchtransient.vis.slices import histogram as histogram
from torchtransient.vis.slices import streak as streak
from torchtransient.vis.tone_mapping import exposure_of as exposure_of
from torchtransient.vis.tone_mapping import exposure_of_video as exposure_of_video
from torchtransient.vis.tone_mapping import tone_map as tone_map
from torchtransient.vis.video import Frames as Frames
from torchtransient.vis.video import frames as frames
from torchtransient.vis.video import side_by_side as side_by_side
from torchtransient.vis.video import video as video
from torchtransient.vis.video_file import write_video as write_video
from torchtransient.vis.view import view as view
from torchtransient.vis.volumes import volume_views as volume_views

"""Pictures, videos and pages of transients: `tt.vis`.

:func:`view` shows anything in a browser, to look at; the others draw pictures and videos for papers, and
:class:`FitMonitor` watches a fit. They take tensors or arrays (C, T, H, W), a RenderOutput, a Capture, or the path of a
result file; they return an RGB array or a matplotlib figure and write a file when they are given a path.
docs/pictures.md shows one of each.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torchtransient.vis.fit_monitor import FitMonitor as FitMonitor
    from torchtransient.vis.pages.page import view as view
    from torchtransient.vis.phasors import phasor_picture as phasor_picture
    from torchtransient.vis.phasors import phasor_video as phasor_video
    from torchtransient.vis.pictures import frame_grid as frame_grid
    from torchtransient.vis.pictures import gradient_picture as gradient_picture
    from torchtransient.vis.pictures import histogram as histogram
    from torchtransient.vis.pictures import peak_time as peak_time
    from torchtransient.vis.pictures import peak_time_picture as peak_time_picture
    from torchtransient.vis.pictures import plot_overview as plot_overview
    from torchtransient.vis.pictures import rainbow as rainbow
    from torchtransient.vis.pictures import streak as streak
    from torchtransient.vis.polarization import polarization_picture as polarization_picture
    from torchtransient.vis.rates import range_doppler as range_doppler
    from torchtransient.vis.scans import scan_layout as scan_layout
    from torchtransient.vis.scans import transients_grid as transients_grid
    from torchtransient.vis.tone_mapping import exposure_of as exposure_of
    from torchtransient.vis.tone_mapping import tone_map as tone_map
    from torchtransient.vis.videos import Frames as Frames
    from torchtransient.vis.videos import frames as frames
    from torchtransient.vis.videos import video as video
    from torchtransient.vis.videos import write_video as write_video
    from torchtransient.vis.volumes import volume_views as volume_views

# Names by file: these import torch, without which the server of large results starts.
_FILES = {
    "fit_monitor": ("FitMonitor",),
    "pages.page": ("view",),
    "phasors": ("phasor_picture", "phasor_video"),
    "pictures": (
        "frame_grid", "gradient_picture", "histogram", "peak_time", "peak_time_picture", "plot_overview", "rainbow",
        "streak",
    ),
    "polarization": ("polarization_picture",),
    "rates": ("range_doppler",),
    "scans": ("scan_layout", "transients_grid"),
    "tone_mapping": ("exposure_of", "tone_map"),
    "videos": ("Frames", "frames", "video", "write_video"),
    "volumes": ("volume_views",),
}
_LAZY = {name: file for file, names in _FILES.items() for name in names}

# Hidden from type checkers, which would take any name for known.
if not TYPE_CHECKING:

    def __getattr__(name):
        if name not in _LAZY:
            raise AttributeError(f"module 'torchtransient.vis' has no attribute {name!r}")
        globals()[name] = getattr(importlib.import_module(f"torchtransient.vis.{_LAZY[name]}"), name)
        return globals()[name]


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})

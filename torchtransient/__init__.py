"""torchtransient: time-resolved light transport as differentiable PyTorch tensors.

Public names are imported when they are first used, so that `import torchtransient` stays cheap; type checkers read the
imports below, and `tests/test_public_names.py` holds the two lists against each other.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from torchtransient import _llvm

_llvm.bind()  # chooses the LLVM that Dr.Jit takes at its import, so nothing above may import mitsuba or drjit

from torchtransient import plugins as plugins  # noqa: E402  lets Mitsuba tell the plugins of a change of variant

if TYPE_CHECKING:
    from torchtransient import accuracy as accuracy
    from torchtransient import data as data
    from torchtransient import errors as errors
    from torchtransient import geometry as geometry
    from torchtransient import losses as losses
    from torchtransient import metrics as metrics
    from torchtransient import nlos as nlos
    from torchtransient import parametrize as parametrize
    from torchtransient import pulses as pulses
    from torchtransient import reconstruction as reconstruction
    from torchtransient import scenes as scenes
    from torchtransient import sensing as sensing
    from torchtransient import stokes as stokes
    from torchtransient import training as training
    from torchtransient import units as units
    from torchtransient import vis as vis
    from torchtransient.accuracy.cost import cost_of_accuracy as cost_of_accuracy
    from torchtransient.axes import FrequencyAxis as FrequencyAxis
    from torchtransient.axes import RateAxis as RateAxis
    from torchtransient.axes import TimeAxis as TimeAxis
    from torchtransient.chirps import Chirps as Chirps
    from torchtransient.gates import Gate as Gate
    from torchtransient.motion.over_time import over_time as over_time
    from torchtransient.motion.rigid_motion import Motion as Motion
    from torchtransient.motion.slow_times import Exposure as Exposure
    from torchtransient.motion.slow_times import Frames as Frames
    from torchtransient.motion.slow_times import PhaseSteps as PhaseSteps
    from torchtransient.motion.slow_times import RollingShutter as RollingShutter
    from torchtransient.pulses import Pulse as Pulse
    from torchtransient.rendering.functional import render as render
    from torchtransient.rendering.output import RenderOutput as RenderOutput
    from torchtransient.rendering.output import RenderStats as RenderStats
    from torchtransient.rendering.plan import Plan as Plan
    from torchtransient.rendering.plan import plan as plan
    from torchtransient.rendering.renderer import TransientRenderer as TransientRenderer
    from torchtransient.rendering.threads import threads as threads
    from torchtransient.rendering.tolerance import ToleranceResult as ToleranceResult
    from torchtransient.rendering.wrap import wrap as wrap
    from torchtransient.scene.load import Scene as Scene
    from torchtransient.scene.load import load as load

__version__ = "0.1.0.dev0"

_LAZY = {
    "Chirps": "torchtransient.chirps",
    "Exposure": "torchtransient.motion.slow_times",
    "Frames": "torchtransient.motion.slow_times",
    "FrequencyAxis": "torchtransient.axes",
    "Gate": "torchtransient.gates",
    "Motion": "torchtransient.motion.rigid_motion",
    "PhaseSteps": "torchtransient.motion.slow_times",
    "Plan": "torchtransient.rendering.plan",
    "Pulse": "torchtransient.pulses",
    "RateAxis": "torchtransient.axes",
    "RenderOutput": "torchtransient.rendering.output",
    "RenderStats": "torchtransient.rendering.output",
    "RollingShutter": "torchtransient.motion.slow_times",
    "Scene": "torchtransient.scene.load",
    "TimeAxis": "torchtransient.axes",
    "ToleranceResult": "torchtransient.rendering.tolerance",
    "TransientRenderer": "torchtransient.rendering.renderer",
    "accuracy": "torchtransient.accuracy",
    "cost_of_accuracy": "torchtransient.accuracy.cost",
    "data": "torchtransient.data",
    "errors": "torchtransient.errors",
    "geometry": "torchtransient.geometry",
    "load": "torchtransient.scene.load",
    "losses": "torchtransient.losses",
    "metrics": "torchtransient.metrics",
    "nlos": "torchtransient.nlos",
    "over_time": "torchtransient.motion.over_time",
    "parametrize": "torchtransient.parametrize",
    "plan": "torchtransient.rendering.plan",
    "pulses": "torchtransient.pulses",
    "reconstruction": "torchtransient.reconstruction",
    "render": "torchtransient.rendering.functional",
    "scenes": "torchtransient.scenes",
    "sensing": "torchtransient.sensing",
    "stokes": "torchtransient.stokes",
    "threads": "torchtransient.rendering.threads",
    "training": "torchtransient.training",
    "units": "torchtransient.units",
    "vis": "torchtransient.vis",
    "wrap": "torchtransient.rendering.wrap",
}

# Hidden from type checkers: a function of any name would give every name, misspelt ones too, its own type.
if not TYPE_CHECKING:

    def __getattr__(name):
        if name not in _LAZY:
            raise AttributeError(f"module 'torchtransient' has no attribute {name!r}")
        module = importlib.import_module(_LAZY[name])
        value = module if _LAZY[name] == f"torchtransient.{name}" else getattr(module, name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})

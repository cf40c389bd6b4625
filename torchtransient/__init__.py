"""torchtransient: time-resolved light transport as differentiable PyTorch tensors."""

import importlib

from torchtransient import _llvm

_llvm.bind()  # chooses the LLVM that Dr.Jit takes at its import, so nothing above may import mitsuba or drjit

from torchtransient import plugins as plugins  # noqa: E402  lets Mitsuba tell the plugins of a change of variant

__version__ = "0.1.0.dev0"

# The room `render` must not hide the function `render`: once the room is imported, later imports leave the name alone.
importlib.import_module("torchtransient.render")
del globals()["render"]

_LAZY = {
    "FrequencyAxis": "torchtransient.axes",
    "Gate": "torchtransient.gates",
    "Pulse": "torchtransient.pulses",
    "RenderOutput": "torchtransient.render.output",
    "RenderStats": "torchtransient.render.output",
    "Scene": "torchtransient.render.scene_handle",
    "TimeAxis": "torchtransient.axes",
    "TransientRenderer": "torchtransient.render.renderer",
    "cost_of_accuracy": "torchtransient.accuracy.cost",
    "data": "torchtransient.data",
    "Plan": "torchtransient.render.plan",
    "geometry": "torchtransient.geometry",
    "load": "torchtransient.render.scene_handle",
    "plan": "torchtransient.render.plan",
    "losses": "torchtransient.losses",
    "nlos": "torchtransient.nlos",
    "parametrize": "torchtransient.parametrize",
    "render": "torchtransient.render.functional",
    "scenes": "torchtransient.scenes",
    "sensing": "torchtransient.sensing",
    "stokes": "torchtransient.stokes",
    "threads": "torchtransient.render.threads",
    "training": "torchtransient.training",
    "vis": "torchtransient.vis",
}


def __getattr__(name: str) -> object:
    """Public names are imported when they are first used: `import torchtransient` stays cheap."""
    if name not in _LAZY:
        raise AttributeError(f"module 'torchtransient' has no attribute {name!r}")
    module = importlib.import_module(_LAZY[name])
    value = module if _LAZY[name] == f"torchtransient.{name}" else getattr(module, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_LAZY])

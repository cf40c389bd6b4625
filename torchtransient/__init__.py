"""torchtransient: time-resolved light transport as differentiable PyTorch tensors."""

from torchtransient import plugins as plugins  # lets Mitsuba tell the plugins of a change of variant

__version__ = "0.1.0.dev0"

"""torchtransient: time-resolved light transport as differentiable PyTorch tensors."""

__version__ = "0.1.0.dev0"

"""torchtransient: time-resolved light transport as differentiable PyTorch tensors."""

from torchtransient import _llvm

_llvm.bind()  # chooses the LLVM that Dr.Jit takes at its import, so nothing above may import mitsuba or drjit

from torchtransient import plugins as plugins  # noqa: E402  lets Mitsuba tell the plugins of a change of variant

__version__ = "0.1.0.dev0"

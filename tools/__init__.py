"""Scenes and programs that tests, benchmarks and pages share. Found from a checkout alone: not part of the package."""

import torchtransient as torchtransient  # first, so that it chooses the LLVM before Dr.Jit is imported

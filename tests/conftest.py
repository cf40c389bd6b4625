"""What every test needs: the package first, so that it chooses the LLVM before Dr.Jit is imported."""

import torchtransient as torchtransient

"""What every test needs: the package first, so that it chooses the LLVM before Dr.Jit is imported."""

import torchtransient as torchtransient  # isort: skip

import mitsuba as mi
import pytest


@pytest.fixture(autouse=True, scope="module")
def _variant(request):
    """A test module that says `VARIANT = "..."` starts with that variant active.

    Rendering a scene of one variant while another one is active switches twice per call, at some 0.1 s each, and what
    an earlier module left active is chance.
    """
    wanted = getattr(request.module, "VARIANT", None)
    if wanted is not None and mi.variant() != wanted:
        mi.set_variant(wanted)

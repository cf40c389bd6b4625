"""What every test needs: the package first, so that it chooses the LLVM before Dr.Jit is imported."""

import os

# NumPy's solver, as torch below: its second thread waits by spinning. It reads this when it is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import torchtransient as torchtransient  # isort: skip

import gc

import mitsuba as mi
import pytest
import torch

from torchtransient import plugins

# Tensors of tests are small: a second thread is no faster, and where the cores are busy all wait for it (five-fold).
torch.set_num_threads(1)


def pytest_collection_finish(session):
    """What is there before the first test stays: collections look at what tests have made, not at every module and
    item each time (0.3 s for each of a hundred and more).
    """
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True, scope="module")
def _variant_of_module(request):
    """A test module that says `VARIANT = "..."` starts with that variant active, its own fixtures too.

    Rendering a scene of one variant while another one is active switches twice per call, at some 0.1 s each, and what
    an earlier module left active is chance.
    """
    _activate(request.module)


@pytest.fixture(scope="module")
def _no_earlier_modules():
    """Before the fixtures of a module are made: what is alive now belongs to no test."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def no_leftovers(_no_earlier_modules):
    """Kernels are those of the test's own objects: a method call is compiled for all that are alive, and what an
    earlier test left to the collector would be freed between two renders.
    """
    gc.collect()


@pytest.fixture(autouse=True)
def _variant_of_test(request):
    """So does each of its tests, whatever the test before it has left active."""
    _activate(request.module)


def _activate(module):
    wanted = getattr(module, "VARIANT", None)
    if wanted is not None:
        if mi.variant() != wanted:
            mi.set_variant(wanted)
        plugins.sync()

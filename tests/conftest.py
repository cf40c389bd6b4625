"""What every test needs: the package first, so that it chooses the LLVM before Dr.Jit is imported."""

import os

# NumPy's solver, as torch below: its second thread waits by spinning. It reads this when it is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import torchtransient as torchtransient  # isort: skip

import faulthandler
import gc
import signal
import sys
import threading
import time

import drjit as dr
import mitsuba as mi
import pytest
import torch
from _pytest.faulthandler import fault_handler_stderr_fd_key

from tools.small_room import VARIANT, make_room
from torchtransient import plugins
from torchtransient.scene.variant import syntax_kept

# A shell lets what it starts in the background ignore interrupts: tests send some to themselves and to their children.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN and threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Tensors of tests are small: a second thread is no faster, and where the cores are busy all wait for it (five-fold).
torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))

# Mitsuba's integrators and the plugins are executed anew at every change of the variant, by whatever test: two thirds
# of the time went into rewriting their source.
_kept = syntax_kept()  # until the process ends
_kept.__enter__()

# Processes that run tests side by side share the cores: threads that wait for work do so by spinning, which is a third
# of what renders of small films cost. One thread alone waits for ever for Mitsuba's OpenEXR files (3.9, written or
# read): tests that call Mitsuba for such a file do it in `with tt.threads(2):`, as users have to.
if (_workers := int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))) > 1:
    dr.set_thread_count(max(1, (os.cpu_count() or 1) // _workers))


# Seconds after which a test waits for ever.
_FOR_EVER = 1200
_watched_since = -float(_FOR_EVER)


def pytest_runtest_setup(item):
    """A test that waits for ever ends its process, which pytest-xdist reports by the test's name. The clock is set once
    a minute and not for each test, as pytest's own is: a thread starts and ends each time, a fifth of a small test.
    """
    global _watched_since
    if time.monotonic() - _watched_since > 60:
        stderr = item.config.stash.get(fault_handler_stderr_fd_key, sys.__stderr__)
        faulthandler.dump_traceback_later(_FOR_EVER, exit=True, file=stderr)
        _watched_since = time.monotonic()


def pytest_sessionfinish():
    faulthandler.cancel_dump_traceback_later()


def pytest_collectstart():
    """Nothing that is imported or found before the first test is garbage."""
    gc.disable()


def pytest_collection_finish(session):
    """What is there before the first test stays: collections look at what tests have made, not at every module and
    item each time (0.3 s for each of a hundred and more).
    """
    gc.enable()
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True, scope="module")
def _variant_of_module(request):
    """A test module that says `VARIANT = "..."` starts with that variant active, its own fixtures too.

    Rendering a scene of one variant while another one is active switches twice per call, at some 0.1 s each, and what
    an earlier module left active is chance.
    """
    _activate(request.module)


@pytest.fixture(autouse=True, scope="module")
def _no_earlier_modules(request):
    """Scenes of an earlier module that wait for the collector are compiled into the kernels of this one, and what is
    attached in them stops its forward mode. What is alive now belongs to no test, and no collection looks at it again.
    """
    if {"mi", "VARIANT"} & set(vars(request.module)):
        gc.collect()
        gc.freeze()


@pytest.fixture
def room() -> dict:
    """The room as a dictionary that a test may change."""
    return make_room()


@pytest.fixture(scope="module")
def room_scene() -> torchtransient.Scene:
    """The room loaded once; scenes are immutable. A scene keeps what was built of it for each kind of film, and every
    kernel has all plugins that are alive: those of other modules are not carried along.
    """
    return torchtransient.load(make_room(), variant=VARIANT)


@pytest.fixture
def no_leftovers():
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

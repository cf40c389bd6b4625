"""Variant, lock and errors of a call.

Mitsuba's variant is a property of the process. A scene of this library is bound to one variant; every call that
touches it runs inside :func:`active_variant`, which switches to that variant when another one is active and switches
back afterwards. When no variant was active at all, there is nothing to go back to, and the scene's variant stays.
"""

from __future__ import annotations

import sys
import traceback
import types
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from torchtransient import plugins
from torchtransient._llvm import ensure_llvm
from torchtransient.checks import shown
from torchtransient.errors import (
    GradientError,
    SceneError,
    TorchTransientError,
    TorchTransientWarning,
    VariantError,
    level_of_user,
)
from torchtransient.plugins.drjit_pool import check_process, engine_lock
from torchtransient.plugins.guards import chain_of, ensure_restored, interrupt_behind, interrupts_wait

DEFAULT_VARIANT = "llvm_ad_rgb"

# A switch takes longer than a small launched call; once or twice is fine, at every step it is not.
MANY_SWITCHES = 20
_switches = {"count": 0}


@contextmanager
def at_work() -> Iterator[bool]:
    """Hold the engine lock, and raise interrupts as themselves. Yields whether this is the outermost block of a thread.

    Raises:
        VariantError: in a forked child, as :func:`check_process`.
    """
    check_process()  # before the lock: a thread that did not come along in a fork may hold it
    # Private, but what threading.Condition asks: there is no other way to ask whether this thread holds it.
    outermost = not engine_lock._is_owned()  # type: ignore[attr-defined]
    with engine_lock, _interrupts_pass():
        yield outermost


@contextmanager
def _interrupts_pass() -> Iterator[None]:
    """Raise the interrupt that ended the block, in place of the RuntimeError that C++ makes of it."""
    # Read before the block: a call in an except block has not failed because of the exception that is handled there.
    interrupt, handled = None, sys.exc_info()[1]
    try:
        yield
    except Exception as error:
        interrupt = interrupt_behind(error, handled)
        if interrupt is None:
            raise
        clear_frames(error, handled)
        raise interrupt from None
    finally:
        # The frame that raises is in the traceback of what it raises: together they would stay until they are
        # collected, and the scene with them.
        del interrupt, handled


def clear_frames(error: BaseException, handled: BaseException | None = None) -> None:
    """Drop local variables in the frames of an error's traceback: attached arrays, plugins of scenes out of use.

    Args:
        error: the error.
        handled: error that was being handled before, whose frames stay.
    """
    for cause in chain_of(error, handled):
        traceback.clear_frames(cause.__traceback__)


@contextmanager
def quiet() -> Iterator[None]:
    """Silence Mitsuba for a block: it warns of parameters that this library differentiates by and Mitsuba does not."""
    import mitsuba as mi

    before = mi.logger().log_level()
    mi.logger().set_log_level(mi.LogLevel.Error)
    try:
        yield
    finally:
        ensure_restored(lambda: mi.logger().set_log_level(before))


def is_differentiable(variant: str | None) -> bool:
    """Return whether a variant compiles kernels and differentiates (``llvm_ad_*``, ``cuda_ad_*``).

    Args:
        variant: name of a variant, None for none.
    """
    return variant is not None and variant.startswith(("llvm_ad_", "cuda_ad_"))


def resolve_variant(requested: str | None) -> str:
    """Return the variant of a scene: the requested one, else the active one if differentiable, else ``llvm_ad_rgb``.

    Args:
        requested: name of a variant, None for no request.

    Raises:
        VariantError: for a variant that is unknown or not differentiable.
    """
    import mitsuba as mi

    if requested is None:
        active = mi.variant()
        return active if is_differentiable(active) else DEFAULT_VARIANT
    if not isinstance(requested, str) or requested not in mi.variants():
        raise VariantError(
            f"variant {shown(requested)} is not part of this Mitsuba; expected one of "
            f"{', '.join(v for v in mi.variants() if is_differentiable(v))}."
        )
    if not is_differentiable(requested):
        raise VariantError(
            f"variant {requested!r} cannot be used: transient rendering compiles kernels and differentiates them. "
            f"Expected one of {', '.join(v for v in mi.variants() if is_differentiable(v))}."
        )
    return requested


def device_type(variant: str) -> str:
    """Return the torch device type whose memory a variant works on, ``cuda`` or ``cpu``.

    Args:
        variant: name of a variant.
    """
    return "cuda" if variant.startswith("cuda") else "cpu"


def stokes_components(variant: str) -> int:
    """Return the number of Stokes components that a variant renders: 4 in polarized ones, otherwise 1.

    Args:
        variant: name of a variant.
    """
    return 4 if variant.endswith("_polarized") else 1


def take_over(device: str) -> None:
    """Make Dr.Jit wait for other threads and for torch, at the beginning of a call on a device.

    What another thread has made may be read in a block of a later number alone, or Dr.Jit refuses: handles of OptiX are
    never evaluated, and torch calls backwards of CUDA tensors in threads of its own. A result that was freed may still
    be read by torch, and Dr.Jit would write to its memory: of torch's streams Dr.Jit's own waits for the default one
    alone.

    Args:
        device: "cuda" or "cpu".
    """
    import drjit as dr

    dr.detail.new_scope(dr.JitBackend.CUDA if device == "cuda" else dr.JitBackend.LLVM)
    if device == "cuda" and torch.cuda.is_initialized():  # type: ignore[no-untyped-call]
        torch.cuda.current_stream().synchronize()


@contextmanager
def active_variant(variant: str) -> Iterator[None]:
    """Hold the engine lock with ``variant`` active and this library's plugins registered for it.

    Another active variant is put back at the end (a switch costs some 6 ms); when none was active, ``variant``
    stays. Nested calls are free. An interrupt inside of the block is raised as such.

    Args:
        variant: name of a variant.
    """
    import mitsuba as mi

    with at_work() as outermost:
        before = mi.variant()
        try:
            if before != variant:
                _set_variant(variant)
                _count_switch(before, variant)
            with interrupts_wait():
                plugins.sync()
            if outermost:
                take_over(device_type(variant))
            yield
        finally:
            ensure_restored(lambda: _put_back(before))


def _put_back(before: str | None) -> None:
    import mitsuba as mi

    if before is not None and mi.variant() != before:
        with interrupts_wait(), syntax_kept():
            mi.set_variant(before)


# Code that Dr.Jit's `syntax` has made, by the code that it was given.
_transformed: dict[Any, types.CodeType] = {}


@contextmanager
def syntax_kept() -> Iterator[None]:
    """Cache the functions that ``dr.syntax`` transforms, for a block with a change of the variant.

    It reads and rewrites source, and Mitsuba executes its own integrators anew at every change: nine tenths of the
    time of a change.
    """
    import drjit as dr

    syntax = dr.syntax

    def kept(f: Any = None, **options: Any) -> Any:
        if f is None:
            return lambda g: kept(g, **options)
        # Equal code objects have the same names, constants and lines.
        key = (f.__code__, f.__code__.co_filename, *sorted(options.items()))
        if key not in _transformed:
            _transformed[key] = syntax(f, **options).__code__
        found = types.FunctionType(_transformed[key], f.__globals__)
        found.__defaults__ = f.__defaults__
        return found

    dr.syntax = kept
    try:
        yield
    finally:
        dr.syntax = syntax


def _count_switch(before: str | None, variant: str) -> None:
    """Count a switch of the variant, and warn once if there are many."""
    if before is None:
        return
    _switches["count"] += 1
    if _switches["count"] == MANY_SWITCHES:
        warnings.warn(
            f"a scene for {variant} is rendered again and again while {before} is active: every call switches to and "
            f"fro, which costs some 6 ms each way. Where all renders of a loop are of one variant, call "
            f"mitsuba.set_variant({variant!r}) before it.",
            TorchTransientWarning,
            stacklevel=level_of_user(),
        )


def _set_variant(variant: str) -> None:
    import mitsuba as mi

    if variant.startswith("llvm"):
        ensure_llvm()
    try:
        with interrupts_wait(), syntax_kept():
            mi.set_variant(variant)
    except (ImportError, RuntimeError) as error:
        raise VariantError(
            f"variant {variant!r} could not be activated: {error}. Run `torchtransient doctor` to see what is missing."
        ) from error


# --------------------------------------------------------------------------------------- errors of kernels

# Dr.Jit's words for an exception inside a loop or call that it traces, and for forward mode that it cannot do.
_INSIDE = "encountered an exception"
_ACROSS = "dr.isolate_grad() scope"
# And for a plugin that asks for the numbers of an array which is not there yet.
_EVALUATED = ": not permitted. "


@contextmanager
def named_errors() -> Iterator[None]:
    """Raise the error of this library that ended a block, or one with the reason, in place of Dr.Jit's RuntimeError."""
    raised: BaseException | None = None
    handled = sys.exc_info()[1]
    try:
        yield
    except RuntimeError as error:
        raised = _instead_of(error, handled)
        if raised is error:
            raise
        clear_frames(error, handled)
        raise raised from (None if raised in chain_of(error, handled) else error)
    finally:
        # A frame must not hold what it raises: both would stay until they are collected, and the scene with them.
        del raised, handled


def _instead_of(error: RuntimeError, handled: BaseException | None) -> BaseException:
    chain = chain_of(error, handled)
    own = next((cause for cause in chain if isinstance(cause, TorchTransientError)), None)
    if own is None and any(words in str(error) for words in (_INSIDE, _ACROSS)):
        return _named(_reason(chain))
    return own or error


def _reason(chain: list[BaseException]) -> BaseException:
    """Return the innermost cause with a message of its own."""
    return next((one for one in reversed(chain) if str(one) and "(see above)" not in str(one)), chain[-1])


def _named(reason: BaseException) -> TorchTransientError:
    words = " ".join(str(reason).split()).rstrip("!.")
    if _ACROSS in words:
        return GradientError(
            "forward mode: Dr.Jit cannot push the tangent of a value into the calls that read it (known of attributes "
            "of shapes with one number at each place, read as a roughness or the weight of a lobe). Use reverse mode, "
            "or a 'bitmap' in the surface itself. Or another scene of this process holds values that are attached "
            "(dr.enable_grad on its parameters, or values computed from such): Dr.Jit builds calls into all objects "
            "alive. Detach them, or let that scene go."
        )
    if _EVALUATED in words:
        return SceneError(
            f"the scene cannot be rendered: one of its plugins evaluates an array while its kernel is built "
            f"({words.split(_EVALUATED)[0]}). Mitsuba's 'timed_sunsky' does: describe a 'sunsky' at its time. A plugin "
            "of your own may not look at values (print them, compare them in an `if`, make numpy arrays of them) in "
            "methods that paths call."
        )
    hint = " A texture or volume may have another number of channels than the place that it stands in."
    return SceneError(
        f"the scene cannot be rendered, {type(reason).__name__} while its kernel was built: {words}."
        + (hint if isinstance(reason, RuntimeError) else "")
    )

"""Which Mitsuba variant a call runs under, and :func:`at_work`, which keeps calls apart.

Mitsuba's variant is a property of the process. A scene of this library is bound to one variant; every call that
touches it runs inside :func:`active_variant`, which switches to that variant when another one is active and switches
back afterwards. When no variant was active at all, there is nothing to go back to, and the scene's variant stays.
"""

from __future__ import annotations

import types
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch

from torchtransient import plugins
from torchtransient._collection import forget_traces
from torchtransient._llvm import ensure_llvm
from torchtransient.checks import one_line, shown
from torchtransient.errors import TorchTransientWarning, VariantError, level_of_user
from torchtransient.plugins.drjit_pool import check_process, engine_lock
from torchtransient.plugins.interrupted import interrupts_wait
from torchtransient.plugins.unfinished import afterwards, make_good
from torchtransient.rendering.interrupts import interrupts_pass

DEFAULT_VARIANT = "llvm_ad_rgb"

# A switch takes longer than a small launched call; once or twice is fine, at every step it is not.
MANY_SWITCHES = 20
_switches = {"count": 0}


@contextmanager
def at_work() -> Iterator[bool]:
    """Hold the engine lock: a call. Raises interrupts as themselves, and puts back what interrupted calls have left, at
    the end of the outermost call or at the beginning of the next. Yields whether it is the outermost one. Raises
    ``VariantError`` as :func:`check_process`.
    """
    check_process()  # before the lock, too: in the child of a fork, a thread that did not come along may hold it
    # Private, but what threading.Condition asks: there is no other way to ask whether this thread holds it.
    outermost = not engine_lock._is_owned()  # type: ignore[attr-defined]
    with engine_lock, interrupts_pass():
        check_process()
        try:
            if outermost:
                put_back_what_is_left()
            yield outermost
        finally:
            if outermost:
                put_back_what_is_left()


def put_back_what_is_left() -> None:
    """Carry out :func:`make_good`, with a warning for what cannot be put back, and let the collector go on. The engine
    lock is held, and no call is under way.
    """
    forget_traces()
    for error in make_good():
        warnings.warn(
            f"a call was interrupted and left a change that cannot be undone: {type(error).__name__}: "
            f"{one_line(error)}. If it was rendering a scene, load that scene again.",
            TorchTransientWarning,
            stacklevel=level_of_user(),
        )


def in_variant(variant: str | None, put_back: Callable[[], object]) -> Callable[[], object]:
    """For :func:`.unfinished.afterwards`, ``put_back`` of something that belongs to a variant: another one may be
    active when it runs late.
    """
    import mitsuba as mi

    def run() -> None:
        if variant is None or mi.variant() == variant:
            put_back()
            return
        with active_variant(variant):
            put_back()

    return run


def is_differentiable(variant: str | None) -> bool:
    """Whether a variant compiles kernels and differentiates (``llvm_ad_*``, ``cuda_ad_*``)."""
    return variant is not None and variant.startswith(("llvm_ad_", "cuda_ad_"))


def resolve_variant(requested: str | None) -> str:
    """The variant of a scene: the requested one, else the active one if it is differentiable, else ``llvm_ad_rgb``.

    Raises ``VariantError`` for a variant that is unknown or not differentiable.
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
    """The torch device type whose memory a variant works on: ``cuda`` or ``cpu``."""
    return "cuda" if variant.startswith("cuda") else "cpu"


def stokes_components(variant: str) -> int:
    """Components of the light that a variant renders: the four of a Stokes vector in polarized ones, otherwise 1."""
    return 4 if variant.endswith("_polarized") else 1


def take_over(device: str) -> None:
    """Before Dr.Jit works on a device, at the beginning of a call: take over from other threads, and from torch.

    What another thread has made may be read in a block of a later number alone, or Dr.Jit refuses: handles of OptiX are
    never evaluated, and torch calls backwards of CUDA tensors in threads of its own. A result that was freed may still
    be read by torch, and Dr.Jit would write to its memory: of torch's streams Dr.Jit's own waits for the default one
    alone.
    """
    import drjit as dr

    dr.detail.new_scope(dr.JitBackend.CUDA if device == "cuda" else dr.JitBackend.LLVM)
    if device == "cuda" and torch.cuda.is_initialized():  # type: ignore[no-untyped-call]
        torch.cuda.current_stream().synchronize()


@contextmanager
def active_variant(variant: str) -> Iterator[None]:
    """Hold the engine lock with ``variant`` active and this library's plugins registered for it.

    Another active variant is put back at the end (a switch costs some 6 ms); when none was active, ``variant``
    stays. Nested calls are free. An interrupt inside of it is raised as such.
    """
    import mitsuba as mi

    with at_work() as outermost:
        before = mi.variant()

        def switch_back() -> None:
            if mi.variant() == variant:  # and nobody has switched meanwhile
                _put_back(before)

        with afterwards(switch_back):
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
                _put_back(before)


def _put_back(before: str | None) -> None:
    import mitsuba as mi

    if before is not None and mi.variant() != before:
        with interrupts_wait(), syntax_kept():
            mi.set_variant(before)


# Code that Dr.Jit's `syntax` has made, by the code that it was given.
_transformed: dict[Any, types.CodeType] = {}


@contextmanager
def syntax_kept() -> Iterator[None]:
    """Let ``dr.syntax`` transform each function once. It reads and rewrites source, and Mitsuba executes its own
    integrators anew at every change of the variant: nine tenths of the time of a change.
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
    """Say once that the calls of a scene keep switching to and fro."""
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

"""Which Mitsuba variant a call runs under, and the lock that keeps calls apart.

Mitsuba's variant is a property of the process. A scene of this library is bound to one variant; every call that
touches it runs inside :func:`active_variant`, which switches to that variant when another one is active and switches
back afterwards. When no variant was active at all, there is nothing to go back to, and the scene's variant stays.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from torchtransient import plugins
from torchtransient._collection import forget_traces
from torchtransient._llvm import ensure_llvm
from torchtransient.errors import VariantError
from torchtransient.plugins.drjit_pool import check_process, engine_lock
from torchtransient.plugins.unfinished import make_good
from torchtransient.quantities import shown
from torchtransient.rendering.interrupts import interrupts_pass, interrupts_wait

DEFAULT_VARIANT = "llvm_ad_rgb"

# A switch takes some 0.1 s and makes Dr.Jit translate every loop anew; once or twice is fine, at every step it is not.
MANY_SWITCHES = 20
_switches = {"count": 0}


@contextmanager
def at_work() -> Iterator[None]:
    """Hold the engine lock. Interrupts pass, and what they have left changed is put back at the end, or first thing in
    the next call. Raises ``VariantError`` as :func:`check_process`.
    """
    outermost = not engine_lock._is_owned()  # type: ignore[attr-defined]
    with engine_lock, interrupts_pass():
        check_process()
        try:
            if outermost:
                forget_traces()
                make_good()
            yield
        finally:
            if outermost:
                make_good()


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


@contextmanager
def active_variant(variant: str) -> Iterator[None]:
    """Hold the engine lock with ``variant`` active and this library's plugins registered for it.

    Another active variant is put back at the end (a switch costs some 50 ms); when none was active, ``variant``
    stays. Nested calls are free. An interrupt inside of it is raised as such.
    """
    import mitsuba as mi

    with at_work():
        before = mi.variant()
        try:
            if before != variant:
                _set_variant(variant)
                _count_switch(before, variant)
            with interrupts_wait():
                plugins.sync()
            yield
        finally:
            if before is not None and mi.variant() != before:
                with interrupts_wait():
                    mi.set_variant(before)


def _count_switch(before: str | None, variant: str) -> None:
    """Say once that the calls of a scene keep switching to and fro."""
    if before is None:
        return
    _switches["count"] += 1
    if _switches["count"] == MANY_SWITCHES:
        warnings.warn(
            f"a scene for {variant} is rendered again and again while {before} is active: every call switches to and "
            f"fro, which costs some 0.1 s each way. Call mitsuba.set_variant({variant!r}) once before the loop.",
            UserWarning,
            stacklevel=2,
        )


def _set_variant(variant: str) -> None:
    import mitsuba as mi

    if variant.startswith("llvm"):
        ensure_llvm()
    try:
        with interrupts_wait():
            mi.set_variant(variant)
    except (ImportError, RuntimeError) as error:
        raise VariantError(
            f"variant {variant!r} could not be activated: {error}. Run `torchtransient doctor` to see what is missing."
        ) from error

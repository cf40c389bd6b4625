"""What the plugins ask about the active Mitsuba variant.

Nothing here is bound to one variant: every function looks at the variant that is active when it is called.
"""

from __future__ import annotations

import mitsuba as mi

from torchtransient.errors import VariantError

_JIT_PREFIXES = ("llvm_", "cuda_", "metal_")


def active_variant() -> str | None:
    """Name of the active Mitsuba variant, or None when none has been set yet."""
    variant: str | None = mi.variant()
    return variant


def is_jit(variant: str | None) -> bool:
    """Whether a variant compiles its kernels with Dr.Jit (`llvm_*`, `cuda_*`, `metal_*`)."""
    return variant is not None and variant.startswith(_JIT_PREFIXES)


def require_jit_variant(what: str) -> str:
    """Return the active variant, or raise VariantError when `what` cannot work in it (none set, or a scalar one)."""
    variant = active_variant()
    if variant is None:
        raise VariantError(
            f"{what} needs an active Mitsuba variant and none is set. Call mi.set_variant('llvm_ad_rgb') first."
        )
    if not is_jit(variant):
        raise VariantError(
            f"{what} works on whole arrays and needs a Dr.Jit variant (llvm_ad_*, cuda_ad_*); the active variant is "
            f"'{variant}'. Call mi.set_variant('llvm_ad_rgb') before the scene is loaded."
        )
    return variant

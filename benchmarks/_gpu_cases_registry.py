"""What a case of `gpu_cases.py` is, and the process of one: `python _gpu_cases_registry.py NAME VARIANT FILE.npz`.

To add one, write a function under `@case` in a `_gpu_cases_*.py` file. It gets a `Side` and returns what it found by
name: tensors and arrays are compared with those of the reference, a `bool` of Python is a fact that must hold. Names
`call 0: ...`, `call 1: ...` are calls of one seed, which must also agree among themselves (`CALLS_RTOL`).

Tolerances are of norms: |cuda - llvm| / |llvm| of each tensor. Equal seeds draw equal samples in both, so that what
differs is rounding, 1e-7 to 1e-5 where every path stays what it was (seen on an H200). `rtol` leaves room for the few
that do not: a path at an edge, a bin's border or a choice that rounding turns over is worth about one sample of the few
thousand of a case. A wrong kernel, a lost scatter or a memory read too early is off by its whole value.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

CASE_FILES = ("_gpu_cases_arrays", "_gpu_cases_renders", "_gpu_cases_scenes")
# Recorded kernels add in another order than traced ones, and atomics in any: 1e-6 was seen.
CALLS_RTOL = 1e-4
Found = dict[str, Any]


@dataclass(frozen=True)
class Side:
    """A variant, and torch's device for it."""

    variant: str

    @property
    def device(self) -> str:
        return "cuda" if self.variant.startswith("cuda") else "cpu"


@dataclass(frozen=True)
class Case:
    """`kind`: the end of the variant's name. `compared`: the reference runs too. `cuda_only`: nothing to see elsewhere.

    `quick`: one of the few cheap ones that show that everything works.
    """

    find: Callable[[Side], Found]
    kind: str = "rgb"
    rtol: float = 1e-2
    compared: bool = True
    cuda_only: bool = False
    quick: bool = False


_CASES: dict[str, Case] = {}


def case(kind: str = "rgb", **more: Any) -> Callable[[Callable[[Side], Found]], Callable[[Side], Found]]:
    """Enter a function among the cases, under its own name."""

    def enter(find: Callable[[Side], Found]) -> Callable[[Side], Found]:
        _CASES[find.__name__] = Case(find, kind, **more)
        return find

    return enter


def all_cases() -> dict[str, Case]:
    """The cases of every file, in their order."""
    for name in CASE_FILES:
        importlib.import_module(name)
    return _CASES


def main(name: str, variant: str, file: str) -> None:
    """Run one case and keep what it found."""
    import torchtransient as tt  # first: it finds LLVM before Dr.Jit is imported

    import mitsuba as mi  # isort: skip

    mi.set_variant(variant)
    tt.plugins.sync()
    arrays = {}
    for key, value in all_cases()[name].find(Side(variant)).items():
        arrays[key] = np.asarray(value.detach().cpu().numpy() if hasattr(value, "detach") else value)
    np.savez(file, **arrays)


if __name__ == "__main__":
    # By its module's name: the case files enter their cases there, not in `__main__`.
    importlib.import_module("_gpu_cases_registry").main(*sys.argv[1:])

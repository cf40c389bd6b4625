"""A diffuse BSDF as users write them in Python, which keeps what it computes of its parameter in whatever way."""

from __future__ import annotations

from array import array
from collections import OrderedDict, deque
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
import torch


class Pair(NamedTuple):
    gain: float


class Slotted:
    __slots__ = ("gain",)

    def __init__(self, gain: float) -> None:
        self.gain = gain


class Numbers(list):
    pass


# How a number may be kept: (made of it, read again).
KEPT: dict[str, tuple[Any, Any]] = {
    "float": (float, float),
    "list": (lambda x: [x], lambda c: c[0]),
    "dictionary": (lambda x: {"gain": x}, lambda c: c["gain"]),
    "ordered dictionary": (lambda x: OrderedDict(gain=x), lambda c: c["gain"]),
    "named tuple": (Pair, lambda c: c.gain),
    "slots": (Slotted, lambda c: c.gain),
    "class of lists": (lambda x: Numbers([x]), lambda c: c[0]),
    "deque": (lambda x: deque([x]), lambda c: c[0]),
    "partial": (lambda x: partial(float, x), lambda c: c()),
    "function": (lambda x: lambda: x, lambda c: c()),
    "default": (lambda x: lambda y=x: y, lambda c: c()),
    "array": (lambda x: array("d", [x]), lambda c: c[0]),
    "NumPy": (lambda x: np.full(5000, x), lambda c: float(c[0])),
    "torch": (lambda x: torch.full((5000,), x), lambda c: float(c[2500])),
    "scalar array": (lambda x: dr.scalar.ArrayXf([x] * 5000), lambda c: c[2500]),
    "scalar colour": (lambda x: mi.ScalarColor3f(x), lambda c: c[1]),
    "plain object": (lambda x: SimpleNamespace(gain=x), lambda c: c.gain),
    "generator": (lambda x: (x for _ in range(10**6)), next),
    "array of Dr.Jit in a plain object": (lambda x: SimpleNamespace(gain=dr.opaque(mi.Float, x)), lambda c: c.gain),
}


def register(kept: str, says: bool, lazy: bool = False) -> str:
    """The BSDF with one way of keeping, for the active variant; returns its plugin name. ``says``: that it can be
    recorded; ``lazy``: keeps an array that it makes when it is first asked for.
    """
    make, read = KEPT[kept]

    class Paint(mi.BSDF):
        can_be_recorded = says

        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.value = mi.Float(0.5)
            self.m_flags = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
            self.m_components = [self.m_flags]
            self.parameters_changed()

        def traverse(self, cb):
            cb.put("value", self.value, +mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys=()):
            self.cache = None if lazy else make(float(np.array(mi.Float(dr.detach(self.value)))[0]))

        def gain(self):
            if lazy:
                if self.cache is None:
                    self.cache = dr.detach(self.value) * 1
                return self.cache
            return mi.Float(read(self.cache))

        def sample(self, ctx, si, u, v, active=True):
            bs = dr.zeros(mi.BSDFSample3f)
            bs.wo = mi.warp.square_to_cosine_hemisphere(v)
            bs.pdf, bs.eta = mi.warp.square_to_cosine_hemisphere_pdf(bs.wo), mi.Float(1)
            bs.sampled_type = mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
            return bs, mi.Spectrum(self.gain()) & active

        def eval(self, ctx, si, wo, active=True):
            return mi.Spectrum(self.gain() * self.pdf(ctx, si, wo, active))

        def pdf(self, ctx, si, wo, active=True):
            return dr.select((si.wi.z > 0) & (wo.z > 0), mi.warp.square_to_cosine_hemisphere_pdf(wo), 0)

        def eval_pdf(self, ctx, si, wo, active=True):
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def to_string(self):
            return "Paint[]"

    name = f"paint_{abs(hash((kept, says, lazy)))}"
    mi.register_bsdf(name, Paint)
    return name

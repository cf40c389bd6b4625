"""The record of a path in thread-local memory: what the reverse sweep cannot recompute cheaply.

Its size is per lane in flight, not per path, and it lives in the kernel's stack: global memory does not grow with the
depth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.integrators.media.leg_record import allocate_legs, read_leg

LIT, DELTA, CONTINUES = 1, 2, 4


def allocate(depth: int, facts) -> dict:
    """Local arrays for ``depth`` vertices."""
    size = depth + 1
    store = {
        "o": dr.alloc_local(mi.Point3f, size),
        "d": dr.alloc_local(mi.Vector3f, size),
        "t": dr.alloc_local(mi.Float, size),
        "uv": dr.alloc_local(mi.Point2f, size),
        "prim": dr.alloc_local(mi.UInt32, size),
        "shape": dr.alloc_local(mi.UInt32, size),
        "shape_index": dr.alloc_local(mi.UInt32, size),
        "beta": dr.alloc_local(mi.Spectrum, size),
        "tau": dr.alloc_local(mi.Float64, size),
        "mis": dr.alloc_local(mi.Float, size),
        "rr": dr.alloc_local(mi.Float, size),
        "u_em": dr.alloc_local(mi.Point2f, size),
        "u_dir": dr.alloc_local(mi.Point2f, size),
        "flags": dr.alloc_local(mi.UInt32, size),
    }
    if facts.delta or facts.refracts:
        store["eta"] = dr.alloc_local(mi.Float, size)
        store["u_lobe"] = dr.alloc_local(mi.Float, size)
    if facts.delays is not None:
        store["u_late"] = dr.alloc_local(mi.Point2f, size)
        if facts.delays.shifts:
            store["wavelengths"] = dr.alloc_local(mi.UnpolarizedSpectrum, size)
    if facts.instances:
        store["instance"] = dr.alloc_local(mi.UInt32, size)
    allocate_legs(store, size, facts)
    return store


def write_vertex(
    store, k, active, facts, ray, pi, β, τ, η, mis, rr, u_em, u_lobe, u_dir, lit, is_delta, goes_on, u_late=None
):
    """Write vertex ``k``."""
    store["o"].write(ray.o, k, active)
    store["d"].write(ray.d, k, active)
    store["t"].write(pi.t, k, active)
    store["uv"].write(pi.prim_uv, k, active)
    store["prim"].write(pi.prim_index, k, active)
    store["shape"].write(dr.reinterpret_array(mi.UInt32, pi.shape), k, active)
    store["shape_index"].write(pi.shape_index, k, active)
    store["beta"].write(β, k, active)
    store["tau"].write(τ, k, active)
    store["mis"].write(mis, k, active)
    store["rr"].write(rr, k, active)
    store["u_em"].write(u_em, k, active)
    store["u_dir"].write(u_dir, k, active)
    flags = dr.select(lit, mi.UInt32(LIT), 0) | dr.select(is_delta, mi.UInt32(DELTA), 0)
    store["flags"].write(flags | dr.select(goes_on, mi.UInt32(CONTINUES), 0), k, active)
    if "eta" in store:
        store["eta"].write(η, k, active)
        store["u_lobe"].write(u_lobe, k, active)
    if "u_late" in store:
        store["u_late"].write(u_late, k, active)
    if "wavelengths" in store:
        store["wavelengths"].write(ray.wavelengths, k, active)
    if "instance" in store:
        store["instance"].write(dr.reinterpret_array(mi.UInt32, pi.instance), k, active)


@dataclass
class Vertex:
    """One vertex read back from the record. ``medium`` is None in scenes without media."""

    ray: Any
    pi: Any
    β: Any
    τ: Any
    η: Any
    mis: Any
    rr: Any
    u_em: Any
    u_lobe: Any
    u_dir: Any
    lit: Any
    is_delta: Any
    goes_on: Any
    scatter: Any
    medium: Any
    u_late: Any = None


def read_vertex(store, k, active, time, wavelengths) -> Vertex:
    """Read vertex ``k``."""
    if "wavelengths" in store:
        wavelengths = store["wavelengths"].read(k, active)
    ray = mi.Ray3f(store["o"].read(k, active), store["d"].read(k, active), time, wavelengths)
    pi = dr.zeros(mi.PreliminaryIntersection3f)
    pi.t = store["t"].read(k, active)
    pi.valid = active & (pi.t < dr.inf)
    pi.prim_uv = store["uv"].read(k, active)
    pi.prim_index = store["prim"].read(k, active)
    pi.shape_index = store["shape_index"].read(k, active)
    pi.shape = dr.reinterpret_array(mi.ShapePtr, store["shape"].read(k, active))
    η, u_lobe = mi.Float(1), mi.Float(0)
    if "eta" in store:
        η, u_lobe = store["eta"].read(k, active), store["u_lobe"].read(k, active)
    if "instance" in store:
        pi.instance = dr.reinterpret_array(mi.ShapePtr, store["instance"].read(k, active))
    flags = store["flags"].read(k, active)
    medium = read_leg(store, k, active)
    return Vertex(
        ray=ray,
        pi=pi,
        β=store["beta"].read(k, active),
        τ=store["tau"].read(k, active),
        η=η,
        mis=store["mis"].read(k, active),
        rr=store["rr"].read(k, active),
        u_em=store["u_em"].read(k, active),
        u_lobe=u_lobe,
        u_dir=store["u_dir"].read(k, active),
        lit=active & ((flags & LIT) != 0),
        is_delta=active & ((flags & DELTA) != 0),
        goes_on=active & ((flags & CONTINUES) != 0),
        scatter=mi.Bool(False) if medium is None else active & (medium.t >= 0),
        medium=medium,
        u_late=store["u_late"].read(k, active) if "u_late" in store else None,
    )

"""What the record of a path keeps of its legs through media."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


class LegEnd:
    """The leg that led to a vertex, and its place in a medium; a plain object that only lives within one iteration.

    ``t``: distance from the ray's origin, where the vertex lies in a medium. ``begin, end``: media at the leg's ends.
    ``walk``: weight of the leg. ``T_em``: transmittance towards the emitter sample. ``entry``: the last boundary that
    the leg passed, where lengths change.
    """

    def __init__(self, t, begin, end, walk, T_em, entry):
        self.t, self.begin, self.end, self.walk, self.T_em, self.entry = t, begin, end, walk, T_em, entry


def allocate_legs(store: dict, size: int, facts) -> None:
    """Add the local arrays for ``size`` legs to a record."""
    if facts.media is None:
        return
    store["t_medium"] = dr.alloc_local(mi.Float, size)
    store["medium_begin"] = dr.alloc_local(mi.UInt32, size)
    store["medium_end"] = dr.alloc_local(mi.UInt32, size)
    store["walk"] = dr.alloc_local(mi.UnpolarizedSpectrum, size)
    store["T_em"] = dr.alloc_local(mi.UnpolarizedSpectrum, size)
    if facts.media.keeps_entry:
        store["entry_t"] = dr.alloc_local(mi.Float, size)
        store["entry_uv"] = dr.alloc_local(mi.Point2f, size)
        for name in ("entry_prim", "entry_shape", "entry_shape_index", "entry_instance"):
            store[name] = dr.alloc_local(mi.UInt32, size)


def write_leg(store: dict, k, active, place, T_em) -> None:
    """Write the leg that led to vertex ``k``; ``place`` as in :mod:`.legs`."""
    if not place:
        return
    # A negative distance stands for a vertex that is not in a medium.
    store["t_medium"].write(dr.select(place["scatter"], place["t"], -1), k, active)
    store["medium_begin"].write(dr.reinterpret_array(mi.UInt32, place["begin"]), k, active)
    store["medium_end"].write(dr.reinterpret_array(mi.UInt32, place["medium"]), k, active)
    store["walk"].write(place["walk"], k, active)
    store["T_em"].write(T_em, k, active)
    if "entry_t" in store:
        entry = place["entry"]
        store["entry_t"].write(entry.t, k, active)
        store["entry_uv"].write(entry.prim_uv, k, active)
        store["entry_prim"].write(entry.prim_index, k, active)
        store["entry_shape"].write(dr.reinterpret_array(mi.UInt32, entry.shape), k, active)
        store["entry_shape_index"].write(entry.shape_index, k, active)
        store["entry_instance"].write(dr.reinterpret_array(mi.UInt32, entry.instance), k, active)


def read_leg(store: dict, k, active) -> LegEnd | None:
    """Read the leg that led to vertex ``k``; None in scenes without media."""
    if "t_medium" not in store:
        return None
    entry = None
    if "entry_t" in store:
        entry = dr.zeros(mi.PreliminaryIntersection3f)
        entry.t = store["entry_t"].read(k, active)
        entry.valid = active & (entry.t < dr.inf)
        entry.prim_uv = store["entry_uv"].read(k, active)
        entry.prim_index = store["entry_prim"].read(k, active)
        entry.shape = dr.reinterpret_array(mi.ShapePtr, store["entry_shape"].read(k, active))
        entry.shape_index = store["entry_shape_index"].read(k, active)
        entry.instance = dr.reinterpret_array(mi.ShapePtr, store["entry_instance"].read(k, active))
    return LegEnd(
        t=store["t_medium"].read(k, active),
        begin=dr.reinterpret_array(mi.MediumPtr, store["medium_begin"].read(k, active)),
        end=dr.reinterpret_array(mi.MediumPtr, store["medium_end"].read(k, active)),
        walk=store["walk"].read(k, active),
        T_em=store["T_em"].read(k, active),
        entry=entry,
    )

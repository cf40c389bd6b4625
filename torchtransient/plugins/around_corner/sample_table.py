"""Shared samples in packets of four numbers, as the loops over them load them."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.sampling.packed import packed_columns
from torchtransient.plugins.sampling.shared_samples import SharedSamples
from torchtransient.plugins.transport.strategy import Local


class SampleTable:
    """Rows of ``[p, f0] [n, b0] (RGB: [f1, f2, b1, b2]) (interpolated normals: [geometric n, -])``: places, normals,
    and what front and back scatter, times the weight of the sample.

    With ``delay`` each sample is lit by one laser spot: ``f`` is what arrives there times what it scatters, ``n``
    points to the side that is lit, and in place of ``b0`` stands the length of the way to the spot, metres.
    """

    def __init__(self, samples: SharedSamples, front: Any = None, n: Any = None, delay: Any = None) -> None:
        self.count, self.smooth, self.lit = samples.count, samples.smooth, delay is not None
        n = samples.n if n is None else n
        f = list(samples.front * samples.weight if front is None else front)
        b = list(samples.back * samples.weight)
        rows = [[*samples.p, f[0]], [*n, b[0] if delay is None else delay]]
        if len(f) > 1:
            rows.append([f[1], f[2], b[1], b[2]])
        if samples.smooth:
            rows.append([*samples.geometric_n, mi.Float(0)])
        self.packets, self.channels = len(rows), len(f)
        self.flat = packed_columns(rows, samples.count * samples.tiles)

    def load(self, k: Any, active: Any = True) -> Local:
        """``p``, ``n``, ``geometric_n``, ``front``, ``back`` and ``delay`` of samples."""
        rows = [dr.gather(mi.Vector4f, self.flat, k * self.packets + i, active) for i in range(self.packets)]
        n = mi.Vector3f(rows[1].x, rows[1].y, rows[1].z)
        front, back = [rows[0].w], [rows[1].w]
        if self.channels > 1:
            front += [rows[2].x, rows[2].y]
            back += [rows[2].z, rows[2].w]
        last = rows[-1]
        return Local(
            p=mi.Point3f(rows[0].x, rows[0].y, rows[0].z), n=n,
            geometric_n=mi.Vector3f(last.x, last.y, last.z) if self.smooth else n,
            front=mi.UnpolarizedSpectrum(front), back=mi.UnpolarizedSpectrum(back), delay=rows[1].w,
        )  # fmt: skip

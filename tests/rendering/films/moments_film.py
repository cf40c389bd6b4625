"""A film that no file of the package knows: the first moments of the arrival time, ``sum of f (opl - start_opl)^k``."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins import register
from torchtransient.plugins.films.base import TimeResolvedFilm


class MomentsFilm(TimeResolvedFilm):
    plugin, measures = "moments_hdr_film", "moments"
    has_window = False

    def __init__(self, props):
        super().__init__(props)
        self.moments = int(props.get("moments", 3))

    def cube_shape(self):
        size = self.crop_size()
        return int(size[1]), int(size[0]), self.moments, self.channel_count()

    def put(self, band, base, opl_from_start, value, active):
        self._add(band, base, [[v * opl_from_start**k for v in value] for k in range(self.moments)], active)
        return mi.Float(0), mi.Float(0)

    def put_slope(self, band, base, opl_from_start, d_value, value_d_opl, active):
        τ, rows = opl_from_start, []
        for k in range(self.moments):
            slope = k * τ ** max(k - 1, 0)
            rows.append([d * τ**k + f * slope for d, f in zip(d_value, value_d_opl, strict=True)])
        self._add(band, base, rows, active)

    def _add(self, band, base, rows, active):
        array, channels = self.band_array(band), self.channel_count()
        for k, row in enumerate(rows):
            for c, value in enumerate(row):
                dr.scatter_reduce(dr.ReduceOp.Add, array, mi.Float(value), base + (k * channels + c), active)

    def read(self, adjoint, base, opl_from_start, active, steady=None):
        flat, stride, entry = adjoint
        A, slope = ([mi.Float(0) for _ in range(self.channel_count())] for _ in range(2))
        for k in range(self.moments):
            for c in range(self.channel_count()):
                a = dr.gather(mi.Float, flat, base + k * stride + c * entry, active)
                A[c] += mi.Float(a * opl_from_start**k)
                slope[c] += mi.Float(a * k * opl_from_start ** max(k - 1, 0))
        return A, slope


register("film", "moments_hdr_film", MomentsFilm)

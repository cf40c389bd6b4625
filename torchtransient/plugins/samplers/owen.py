"""``owen``: Owen-scrambled points of four dimensions, padded to any number of dimensions."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins._registry import register
from torchtransient.plugins.properties import whole_number
from torchtransient.plugins.sampling.point_sets import hashed, scrambled, second_pair, sobol_second, unit_float


class OwenSampler(mi.Sampler):
    """Samples that spread evenly over every dimension, and over every pair of dimensions drawn by ``next_2d``.

    Each call draws from a scrambled (0, 2)-sequence. Two calls in a row, the first and the second, the third and the
    fourth, have theirs in a common order, in which the four numbers spread as evenly as Sobol's; others have orders of
    their own (padding: Kollig and Keller 2002). Scrambling and order are Owen's, by hashes (Burley 2020), and differ
    between pixels, seeds and calls: every number is uniform by itself, so that means are unbiased.

    ``sample_count`` (4): samples per pixel, any number; powers of two are spread most evenly. ``seed`` (0): shifts the
    seeds of renders.

    Mitsuba's integrators in C++ do not say how many samples of a pixel a wavefront has: their numbers are independent
    ones. Not supported: scalar variants.
    """

    can_be_recorded = True

    def __init__(self, props):
        super().__init__(props)
        self._props_seed = whole_number(props, "seed", 0, least=0)
        self._per_wavefront, self._size = 1, 0
        self.index = mi.UInt32(0)        # number of the lane's sample in its pixel
        self.key = mi.UInt32(0)          # hash of seed and pixel
        self.dimension = mi.UInt32(0)    # number of calls so far

    def fork(self):
        props = mi.Properties("owen")
        props["sample_count"], props["seed"] = self.sample_count(), self._props_seed
        twin = type(self)(props)
        twin.set_samples_per_wavefront(self._per_wavefront)
        return twin

    def clone(self):
        twin = self.fork()
        twin._size = self._size
        twin.index, twin.key, twin.dimension = (mi.UInt32(x) for x in (self.index, self.key, self.dimension))
        return twin

    def set_samples_per_wavefront(self, samples_per_wavefront):
        self._per_wavefront = int(samples_per_wavefront)

    def wavefront_size(self):
        return self._size

    def seed(self, seed, wavefront_size=0xFFFFFFFF):
        if wavefront_size != 0xFFFFFFFF:
            self._size = wavefront_size
        lane, count = dr.arange(mi.UInt32, self._size), dr.opaque(mi.UInt32, self._per_wavefront)
        pixel = lane // count
        self.seed_sets(seed, pixel, lane - pixel * count)

    def seed_sets(self, seed, pixel, index):
        """Seed lanes that are in any order.

        Args:
            seed: UInt32.
            pixel: number of each lane's set of samples, UInt32.
            index: number of its sample in the set, UInt32.
        """
        self._size = dr.width(index)
        self.index = index
        seed = hashed(mi.UInt32(seed) + hashed(dr.opaque(mi.UInt32, self._props_seed)))
        self.key = hashed(seed ^ hashed(pixel + 0x51ED270B))
        self.dimension = mi.UInt32(0)

    def advance(self):
        self.index += dr.opaque(mi.UInt32, self._per_wavefront)
        self.dimension = mi.UInt32(0)

    def schedule_state(self):
        dr.schedule(self.index, self.key, self.dimension)

    def next_1d(self, active=True):
        i, key = self._next()
        return unit_float(scrambled(dr.brev(i), hashed(key ^ 0x68BC21EB)))

    def next_2d(self, active=True):
        i, key = self._next()
        x = scrambled(dr.brev(i), hashed(key ^ 0x68BC21EB))
        return mi.Point2f(unit_float(x), unit_float(scrambled(sobol_second(i), hashed(key ^ 0x02E5BE93))))

    def _next(self):
        """Return the number of the next point in its sequence, and the key that scrambles its coordinates."""
        key, second = hashed(self.key ^ ((self.dimension >> 1) * 0x9E3779B9)), self.dimension & 1
        self.dimension += 1
        # Aligned blocks of numbers stay together, so that what they hold stays a net.
        i = scrambled(self.index, key)
        return dr.select(second == 1, second_pair(i), i), key ^ (second * 0x5BD1E995)

    def to_string(self):
        return f"OwenSampler[\n  sample_count = {self.sample_count()},\n  seed = {self._props_seed}\n]"


register("sampler", "owen", OwenSampler)

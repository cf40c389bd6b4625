"""Exhaustive captures: a histogram for every pair of a scan point and a laser spot.

The visibility of a sample from a point of the wall, ``cos cos / r^2`` or zero, and the distance are computed once for
each such pair, with one ray, and stored. A lane is a pair of a scan point and a laser spot; it has a histogram of its
own and loops over the samples of a block, with two loads and a product for each. A block has as many samples as memory
allows.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError, ShapeError
from torchtransient.plugins.around_corner.geometry import WallPoints, occluded, span
from torchtransient.plugins.around_corner.third_bounce import ThirdBounce
from torchtransient.plugins.sampling.hidden_elements import packed_columns
from torchtransient.plugins.transport.strategy import Local

# Bytes of the pairs of numbers that are kept at a time, for scan points and laser spots together.
MOST_BYTES = 2**28
# Numbers that are mirrored at a time.
MOST_MIRRORED = 2**24
# Samples that one turn of the loop takes; blocks are filled up with samples that nothing reaches.
UNROLLED = 4


def add_exhaustive(job: ThirdBounce, lasers: WallPoints, reciprocal: bool | None = None) -> None:
    """Add the light of all pairs of a laser spot and a scan point to a film for exhaustive scans.

    Args:
        job: the capture.
        lasers: laser spots, one for each position of the film's laser grid, row by row.
        reciprocal: compute half of the pairs and mirror them, since light goes either way. That is exact to the last
            digit if ``lasers`` and scan points are one object (legs too), normals are not interpolated, and the film
            is stored in one band and holds no light yet; None does it then.

    Raises:
        SceneError: for other films and samples, and for ``reciprocal`` where it is not exact.
        ShapeError: for another number of spots.
    """
    film = job.film
    job.check_region(lasers)
    if not film.exhaustive_scan:
        raise SceneError(
            "add_exhaustive: expected a film with a histogram for every pair of laser and sensor position; set "
            "exhaustive_scan, laser_scan_width and laser_scan_height."
        )
    if film.lanes_at_most(1) is not None:
        raise SceneError(
            f"add_exhaustive: expected a film that adds events up at once, got a {film.plugin}, which lists them. Use "
            "the general path integrator."
        )
    if job.samples.tiles > 1:
        raise SceneError(
            "add_exhaustive: expected samples that all scan points share, got those of "
            f"{job.samples.tiles} tiles; build HiddenElements without tiles."
        )
    if lasers.width != film.laser_count():
        raise ShapeError(
            f"add_exhaustive: expected a laser position of the film for every spot, got {film.laser_count()} and "
            f"{lasers.width}."
        )
    possible = lasers is job.sensors and not job.samples.smooth and len(film.band_layout()) == 1
    # Pairs in descending order are copies, which would take the place of what is there.
    possible = possible and not bool(dr.any(film.steady != 0))
    if reciprocal and not possible:
        raise SceneError(
            "add_exhaustive: reciprocity needs the scan points themselves as laser spots, normals that are not "
            "interpolated, and a film of less than 2^32 values without light in it; leave reciprocal out."
        )
    mirrored = possible if reciprocal is None else reciprocal
    points = job.sensors.width + (0 if lasers is job.sensors else lasers.width)
    size = max(UNROLLED, MOST_BYTES // (8 * points) // UNROLLED * UNROLLED)
    blocks = [(k, min(k + size, job.samples.count)) for k in range(0, job.samples.count, size)]
    for number, (first, last) in enumerate(blocks):
        block = SampleBlock(job, lasers, first, last)
        for band, (row, rows) in enumerate(film.band_layout()):
            _launch(job, block, lasers, band, row, rows, mirrored)
            job.done((number + (band + 1) / len(film.band_layout())) / len(blocks), band)
    if mirrored:
        _mirror(film)


class SampleBlock:
    """Block of samples ``first`` to ``last`` (exclusive), with their visibility from all points. A plain class.

    Attributes:
        seen, lit: ``[g, r]`` for each sample and scan point, or laser spot, sample by sample: cosines over the squared
            distance, negative where the back of the sample is seen, and distance (metres).
        values: colours of front and back, None in monochromatic variants: there the square root of the one colour is a
            factor of both ``g``.
    """

    def __init__(self, job: ThirdBounce, lasers: WallPoints, first: int, last: int) -> None:
        self.colours = len(job.energy)
        self.first, self.count = first, last - first
        # Filled up, with rows of zeros.
        self.rows = -(-self.count // UNROLLED) * UNROLLED
        self.size = dr.opaque(mi.UInt32, self.rows)
        self.values = None
        if self.colours > 1:
            sample = dr.opaque(mi.UInt32, first) + dr.arange(mi.UInt32, self.count)
            weight = dr.gather(mi.Float, job.samples.weight, sample)
            sides = [
                dr.gather(mi.UnpolarizedSpectrum, s, sample) * weight for s in (job.samples.front, job.samples.back)
            ]
            self.values = packed_columns([[*side, mi.Float(0)] for side in sides], self.rows)
        self.seen = self._visibility(job, job.sensors, from_laser=False)
        same = lasers is job.sensors and not job.samples.smooth
        self.lit = self.seen if same else self._visibility(job, lasers, from_laser=True)

    def _visibility(self, job: ThirdBounce, points: WallPoints, from_laser: bool) -> Any:
        samples, width = job.samples, dr.opaque(mi.UInt32, points.width)
        lane = dr.arange(mi.UInt32, self.count * points.width)
        row = lane // width
        k = row + dr.opaque(mi.UInt32, self.first)
        p, n, _, _ = points.take(lane - row * width)
        shading_n = mi.Vector3f(dr.gather(mi.Normal3f, samples.n, k))
        geometric_n = mi.Vector3f(dr.gather(mi.Normal3f, samples.geometric_n, k)) if samples.smooth else shading_n
        sample = Local(p=dr.gather(mi.Point3f, samples.p, k), n=shading_n, geometric_n=geometric_n)
        line = span(sample, p, mi.Vector3f(n))
        value = dr.select(
            line.cos > 0,
            dr.gather(mi.UnpolarizedSpectrum, samples.front, k),
            dr.gather(mi.UnpolarizedSpectrum, samples.back, k),
        )
        cos = line.cos if from_laser else line.geometric_cos
        g = dr.abs(cos) * line.wall_cos * line.inverse_square
        if self.colours == 1:
            g *= dr.sqrt(value[0] * dr.gather(mi.Float, samples.weight, k))
        active = (g > 0) & (dr.max(value) > 0)
        active &= ~occluded(job.scene, sample, line, p, mi.Vector3f(n), active & (k >= samples.clear))
        g = dr.select(active, dr.mulsign(g, line.cos), 0)
        table = dr.zeros(mi.Float, 2 * self.rows * points.width)
        dr.scatter(table, mi.Vector2f(g, line.r), lane)
        dr.eval(table)
        return table


class Pairs:
    """Scan point and laser spot of each lane of a launch: constants of the loop. A plain class."""

    def __init__(self, job: ThirdBounce, lasers: WallPoints, pixel: Any, laser: Any) -> None:
        _, _, value, leg = job.sensors.take(pixel)
        _, _, laser_value, laser_leg = lasers.take(laser)
        self.factor = value * job.energy * laser_value
        self.origin = leg + laser_leg - job.film.start_opl
        self.pixel, self.laser = pixel, laser
        self.sensor_count = dr.opaque(mi.UInt32, job.sensors.width)
        self.laser_count = dr.opaque(mi.UInt32, lasers.width)
        dr.eval(self.factor, self.origin, self.pixel, self.laser)


def _launch(
    job: ThirdBounce, block: SampleBlock, lasers: WallPoints, band: int, row: int, rows: int, mirrored: bool
) -> None:
    film = job.film
    width = int(film.crop_size()[0])
    lane = dr.arange(mi.UInt32, width * rows * lasers.width)
    local = lane // dr.opaque(mi.UInt32, lasers.width)
    laser = lane - local * dr.opaque(mi.UInt32, lasers.width)
    pixel = local + dr.opaque(mi.UInt32, row * width)
    pairs = Pairs(job, lasers, pixel, laser)
    wanted = pixel <= laser if mirrored else mi.Mask(True)
    base = film.pixel_base(local * film.entries_per_pixel(), laser)
    target = film.create_event_block(Local(band=band), base, job.match, 1, exclusive=True, origin=pairs.origin)
    sums = {"L": mi.UnpolarizedSpectrum(0), "before": mi.Float(0), "after": mi.Float(0)}
    sums = sum_over_block(job, block, pairs, target, sums, wanted)
    _count(film, job.match, pixel, sums, wanted)
    if mirrored:
        _count(film, job.match, laser, sums, pixel < laser)
    dr.eval(film.bands[band][2], film.steady, film.outside)


def _count(film: Any, match: Any, pixel: Any, sums: dict[str, Any], active: Any) -> None:
    film.add_steady(pixel, [dr.select(active, c, 0) for c in match.to_channels(sums["L"])])
    film.add_outside(pixel, dr.select(active, sums["before"], 0), dr.select(active, sums["after"], 0))


@dr.syntax
def sum_over_block(job, block, pairs, target, sums, wanted):
    """Add the light that goes from each lane's laser spot by the samples of a block to its scan point."""
    k = mi.UInt32(0)
    going = mi.Mask(wanted)
    while dr.hint(going, label="pairs of points"):
        for u in range(UNROLLED):
            deposit(job, block, pairs, target, sums, k + u)
        k += UNROLLED
        going &= k < block.size
    return sums


def deposit(job, block, pairs, target, sums, k):
    """Add the light of sample ``k`` of the block."""
    seen = dr.gather(mi.Vector2f, block.seen, k * pairs.sensor_count + pairs.pixel)
    lit = dr.gather(mi.Vector2f, block.lit, k * pairs.laser_count + pairs.laser)
    g = seen.x * lit.x
    active = g > 0
    opl = seen.y + lit.y
    if job.window is not None:
        active &= job.window.counts(target.counted(opl))
    value = pairs.factor * g
    if block.values is not None:
        row = dr.gather(mi.Vector4f, block.values, 2 * k + dr.select(seen.x > 0, mi.UInt32(0), 1), active)
        value *= mi.UnpolarizedSpectrum(row.x, row.y, row.z)
    sums["L"] = sums["L"] + dr.select(active, value, 0)
    before, after = target.put({}, opl, value, active)
    sums["before"] = sums["before"] + before
    sums["after"] = sums["after"] + after


def _rows_at_once(points: int, size: int) -> int:
    """Return the number of scan points whose histograms are mirrored together, few enough to bound the memory."""
    return max(1, MOST_MIRRORED // (points * size))


def _mirror(film: Any) -> None:
    """Copy the histogram of each pair (scan point, laser spot) with ascending numbers to the swapped pair."""
    cube = film.band_array(0)
    points, size = film.laser_count(), film.entries_per_array()
    # Four numbers at once where a histogram is made of fours.
    packet = 4 if size % 4 == 0 else 1
    kind = type(cube) if packet == 1 else (mi.Vector4f if type(cube) is mi.Float else mi.Vector4d)
    parts = size // packet
    at_once = _rows_at_once(points, size)
    for first in range(0, points, at_once):
        rows = min(at_once, points - first)
        i = dr.arange(mi.UInt32, rows * points * parts)
        pair = i // dr.opaque(mi.UInt32, parts)
        part = i - pair * dr.opaque(mi.UInt32, parts)
        point = pair // dr.opaque(mi.UInt32, points)
        laser, point = pair - point * dr.opaque(mi.UInt32, points), point + dr.opaque(mi.UInt32, first)
        below = laser < point
        value = dr.gather(kind, cube, (laser * points + point) * parts + part, below)
        target = (point * points + laser) * parts + part
        # Before the array is written to, which would be copied otherwise.
        dr.eval(value, target, below)
        dr.scatter(cube, value, target, below)
        dr.eval(cube)

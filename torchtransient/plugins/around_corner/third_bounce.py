"""Light of three bounces, laser spot, hidden point, scan point, from hidden samples that all scan points share.

A laser of energy ``Q`` falls on the wall at ``l``, which scatters ``value_l cos Q`` (radiance times area). A hidden
point ``x`` of a diffuse surface lights the scan point ``s``, and the pixel is the radiance that leaves ``s``::

    value_s value_l Q f(x) cos(x, l) cos(l) / r_l^2 cos(x, s) cos(s) / r_s^2        at r_l + r_s + legs

summed over samples ``x`` times the area that each stands for. Where normals are interpolated, the cosine towards the
laser is that of the shading normal and the one towards the scan point that of the surface, as in a path that is traced
from the sensor. Every lane has a scan point (several lanes do, where there are few of them) and loops over the samples,
so that it owns its histogram and no sum is atomic.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError, ShapeError
from torchtransient.plugins.around_corner.geometry import WallPoints, occluded, span
from torchtransient.plugins.around_corner.launches import Launch, ScanJob, launches_of
from torchtransient.plugins.sampling.hidden_elements import packed_columns
from torchtransient.plugins.sampling.shared_samples import SharedSamples
from torchtransient.plugins.transport.strategy import Local

# ------------------------------------------ shared samples in packets of four numbers, as the loops over them load them


class SampleTable:
    """Samples in memory, in packets of four numbers.

    Rows are ``[p, f0] [n, b0] (RGB: [f1, f2, b1, b2]) (interpolated normals: [geometric n, -])``: place, normal, and
    albedo over pi of front and back, times the weight of the sample.

    Args:
        samples: the samples.
        front, n, delay: arrays of samples that are lit by one laser spot, else None: scattered light in place of ``f``,
            normals of the sides that are lit, and lengths of the ways to the spot (metres) in place of ``b0``.
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
        """Return ``p``, ``n``, ``geometric_n``, ``front``, ``back`` and ``delay`` of samples ``k`` (UInt32)."""
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


# ----------------------------------------------------------------------------------------------------------------------


class ThirdBounce(ScanJob):
    """Light of three bounces of a capture, which ``add_confocal``, ``add_pairs`` or ``add_single`` adds to the film.

    Not supported: spectral and polarized variants; derivatives.

    Args:
        scene, film, sensors, energy, progress: scene, film, scan points, energy of the laser (J) and function of the
            fraction that is done, see :class:`.launches.ScanJob`.
        samples: hidden samples.
        tile: tile whose samples each scan point takes (UInt32), None for samples without tiles.

    Raises:
        SceneError, ShapeError, VariantError: as :class:`.launches.ScanJob`; ``ShapeError`` for tiles that do not fit.
    """

    def __init__(
        self,
        scene: Any,
        film: Any,
        samples: SharedSamples,
        sensors: WallPoints,
        energy: Any = 1.0,
        progress: Any = None,
        tile: Any = None,
    ) -> None:
        super().__init__(scene, film, sensors, energy, progress)
        if (samples.tiles > 1) != (tile is not None) or (tile is not None and dr.width(tile) != sensors.width):
            raise ShapeError(
                f"ThirdBounce: expected the tile of every scan point for samples of {samples.tiles} tiles, and none "
                f"for one; got {'none' if tile is None else dr.width(tile)}."
            )
        self.samples = samples
        self.tile = tile
        self.check_region(sensors)

    def add_pairs(self, lasers: WallPoints) -> None:
        """Add light of a laser with a spot for each scan point, ``lasers``."""
        self._add_each("add_pairs", lasers, apart=True)

    def add_confocal(self, lasers: WallPoints | None = None) -> None:
        """Add light of a laser that falls on each scan point while it is scanned.

        Args:
            lasers: the same points with the legs and albedo of the laser's side, None where those do not differ.
        """
        self._add_each("add_confocal", self.sensors if lasers is None else lasers, apart=False)

    def _add_each(self, name: str, lasers: WallPoints, apart: bool) -> None:
        if lasers.width != self.sensors.width:
            raise ShapeError(
                f"{name}: expected a laser spot for every scan point, got {lasers.width} spots and "
                f"{self.sensors.width} points."
            )
        self._check_not_exhaustive(name)
        self.check_region(lasers)
        self._run(SampleTable(self.samples), lasers, apart)

    def add_single(self, laser: WallPoints) -> None:
        """Add light of a laser with one fixed spot, ``laser``."""
        if laser.width != 1:
            raise ShapeError(f"add_single: expected one laser spot, got {laser.width}.")
        self._check_not_exhaustive("add_single")
        self.check_region(laser)
        self._run(lit_by(self.scene, self.samples, laser), laser)

    def check_region(self, points: WallPoints) -> None:
        """Raise ShapeError for points outside of the region in which some samples need no visibility rays."""
        if self.samples.has_clear and not self.samples.region.holds(np.array(points.p, dtype=float).T):
            raise ShapeError(
                "ThirdBounce: expected points within the region that shafts.spare_rays was given, got others; hand all "
                "scan points and laser spots to it."
            )

    def _check_not_exhaustive(self, name: str) -> None:
        if self.film.exhaustive_scan:
            raise SceneError(
                f"{name}: expected a film with one histogram a pixel, got one for exhaustive scans. Use "
                "add_exhaustive, or set exhaustive_scan to false."
            )

    def _run(self, table: SampleTable, lasers: WallPoints, apart: bool = False) -> None:
        launches = launches_of(self.film, table.count)
        for i, launch in enumerate(launches):
            self._launch(table, lasers, launch, apart)
            self.done((i + 1) / len(launches), launch.band)

    def _launch(self, table: SampleTable, lasers: WallPoints, launch: Launch, apart: bool) -> None:
        film = self.film
        pixel, first, last = launch.lanes()
        tile = mi.UInt32(0) if self.tile is None else dr.gather(mi.UInt32, self.tile, pixel)
        lane = ScanLanes(self, lasers, pixel, table.lit, apart)
        block = film.create_event_block(
            launch,
            launch.base(film, pixel),
            self.match,
            launch.most_events,
            exclusive=launch.chunks == 1,
            origin=lane.origin,
        )
        sums = {"L": mi.UnpolarizedSpectrum(0), "before": mi.Float(0), "after": mi.Float(0), "block": block.begin()}
        clear = dr.clip(dr.gather(mi.UInt32, self.samples.clear, tile), first, last)
        first, clear, last = (k + tile * dr.opaque(mi.UInt32, table.count) for k in (first, clear, last))
        if self.samples.has_clear:
            sums = _sum_over_samples(self, table, lane, block, sums, (first, clear), False)
            first = clear
        sums = _sum_over_samples(self, table, lane, block, sums, (first, last), True)
        block.end(sums["block"])
        film.add_steady(pixel, self.match.to_channels(sums["L"]))
        film.add_outside(pixel, sums["before"], sums["after"])
        block.finish()


class ScanLanes:
    """Scan points and laser spots of the lanes of a launch: constants of the loop. A plain class.

    ``apart``: spots are not the scan points, and have places ``spot_p`` and normals ``spot_n``.
    """

    def __init__(self, job: ThirdBounce, lasers: WallPoints, pixel: Any, lit: bool, apart: bool) -> None:
        self.p, n, value, leg = job.sensors.take(pixel)
        self.n = mi.Vector3f(n)
        spot_p, spot_n, laser_value, laser_leg = lasers.take(mi.UInt32(0) if lit else pixel)
        self.apart = apart
        if apart:
            self.spot_p, self.spot_n = spot_p, mi.Vector3f(spot_n)
            dr.eval(self.spot_p, self.spot_n)
        # What arrives at the samples of one spot holds neither the spot's albedo nor the energy.
        self.factor = value * job.energy * laser_value
        self.origin = leg + laser_leg - job.film.start_opl
        dr.eval(self.p, self.n, self.factor, self.origin)


@dr.syntax
def _sum_over_samples(job, table, lane, block, sums, numbers, rays):
    """Add the light of samples at the lanes' scan points to the film's ``block`` and to ``sums``.

    ``numbers``: first and last sample, exclusive; ``rays``: trace visibility rays.
    """
    k, last = mi.UInt32(numbers[0]), numbers[1]
    while dr.hint(k < last, label="hidden samples"):
        _deposit(job, table, lane, block, sums, k, rays)
        k += 1
    return sums


def _deposit(job, table, lane, block, sums, k, rays):
    """Add the light of sample ``k``."""
    sample = table.load(k)
    line = span(sample, lane.p, lane.n)
    to_spot = span(sample, lane.spot_p, lane.spot_n) if lane.apart else None
    if lane.apart:
        side, opl = line.cos * to_spot.cos > 0, line.r + to_spot.r
        value = dr.select(line.cos > 0, sample.front, sample.back)
        geometry = dr.abs(line.geometric_cos * to_spot.cos) * line.wall_cos * line.inverse_square
        geometry *= to_spot.wall_cos * to_spot.inverse_square
    elif table.lit:
        side, value, opl = line.cos > 0, sample.front, line.r + sample.delay
        geometry = dr.abs(line.geometric_cos) * line.wall_cos * line.inverse_square
    else:
        side, opl = line.cos != 0, 2 * line.r
        value = dr.select(line.cos > 0, sample.front, sample.back)
        geometry = dr.abs(line.cos * line.geometric_cos) * dr.square(line.wall_cos * line.inverse_square)
    value = value * geometry
    active = side & (dr.max(value) > 0)
    if job.window is not None:
        active &= job.window.counts(block.counted(opl))
    if rays:
        active &= ~occluded(job.scene, sample, line, lane.p, lane.n, active)
        if lane.apart:
            active &= ~occluded(job.scene, sample, to_spot, lane.spot_p, lane.spot_n, active)
    value = value * lane.factor
    sums["L"] = sums["L"] + dr.select(active, value, 0)
    before, after = block.put(sums["block"], opl, value, active)
    sums["before"] = sums["before"] + before
    sums["after"] = sums["after"] + after


def lit_by(scene: Any, samples: SharedSamples, laser: WallPoints) -> SampleTable:
    """Return samples that are lit by one laser spot, with one ray for each.

    Args:
        scene: built scene.
        samples: hidden samples.
        laser: the spot, a single wall point.
    """
    sample = _as_lines(samples)
    p, n, _, _ = laser.take(mi.UInt32(0))
    line = span(sample, p, mi.Vector3f(n))
    arrives = dr.abs(line.cos) * line.wall_cos * line.inverse_square
    reflected = dr.select(line.cos > 0, samples.front, samples.back) * samples.weight
    active = (arrives > 0) & (dr.max(reflected) > 0)
    in_doubt = active & ~_clear(samples)
    active &= ~occluded(scene, sample, line, p, mi.Vector3f(n), in_doubt)
    front = dr.select(active, reflected * arrives, 0)
    return SampleTable(samples, front, dr.mulsign(mi.Vector3f(samples.n), line.cos), line.r)


def _clear(samples: SharedSamples) -> Any:
    """Return a mask of the samples that need no visibility rays."""
    k, count = dr.arange(mi.UInt32, samples.count * samples.tiles), dr.opaque(mi.UInt32, samples.count)
    tile = k // count
    return k - tile * count < dr.gather(mi.UInt32, samples.clear, tile)


def _as_lines(samples: SharedSamples) -> Any:
    n = mi.Vector3f(samples.n)
    return Local(p=samples.p, n=n, geometric_n=mi.Vector3f(samples.geometric_n) if samples.smooth else n)

# ----------------------------------------------------------------------------------------------------------------------
# Exhaustive captures: a histogram for every pair of a scan point and a laser spot. The visibility of a sample from a
# point of the wall, cos cos / r^2 or zero, and the distance are computed once for each such pair, with one ray, and
# stored. A lane is a pair of a scan point and a laser spot; it has a histogram of its own and loops over the samples of
# a block, with two loads and a product for each. A block has as many samples as memory allows.

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
    sums = _sum_over_block(job, block, pairs, target, sums, wanted)
    _count(film, job.match, pixel, sums, wanted)
    if mirrored:
        _count(film, job.match, laser, sums, pixel < laser)
    dr.eval(film.bands[band][2], film.steady, film.outside)


def _count(film: Any, match: Any, pixel: Any, sums: dict[str, Any], active: Any) -> None:
    film.add_steady(pixel, [dr.select(active, c, 0) for c in match.to_channels(sums["L"])])
    film.add_outside(pixel, dr.select(active, sums["before"], 0), dr.select(active, sums["after"], 0))


@dr.syntax
def _sum_over_block(job, block, pairs, target, sums, wanted):
    """Add the light that goes from each lane's laser spot by the samples of a block to its scan point."""
    k = mi.UInt32(0)
    going = mi.Mask(wanted)
    while dr.hint(going, label="pairs of points"):
        for u in range(UNROLLED):
            _deposit_pair(job, block, pairs, target, sums, k + u)
        k += UNROLLED
        going &= k < block.size
    return sums


def _deposit_pair(job, block, pairs, target, sums, k):
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

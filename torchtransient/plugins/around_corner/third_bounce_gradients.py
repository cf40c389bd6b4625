"""Derivatives of third-bounce light from shared samples, confocal and single, in both modes.

Reverse mode has a lane for each hidden sample, which loops over the scanned points and keeps the adjoint of its sample
to itself: no sum is atomic, whatever the number of connections. What belongs to the scanned points is found in a
second pass, with a lane for each of them. The adjoints of samples and points are then handed on to the scene once. In
forward mode the tangents of samples and points are tables; every connection puts ``k df + f k' dtau`` onto the film.

Samples are material points: with the density held fixed per area of material, a lone body's outline needs no boundary
term. What stands in between is asked again and held fixed; bodies that hide each other need the term of their edges.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.around_corner.attached import Ends, leaves, three_bounces
from torchtransient.plugins.around_corner.geometry import occluded
from torchtransient.plugins.around_corner.launches import launches_of
from torchtransient.plugins.films.colour import ChannelMatch
from torchtransient.plugins.transport.carry import slope_only, total_of
from torchtransient.plugins.transport.derivative.forward import tangents_of
from torchtransient.plugins.transport.strategy import Local

# Lanes that keep all cores busy.
BUSY = 2**14


class ThirdBounceGradients:
    """One job of derivatives. ``light``: the :class:`.shared_light.ScanLight`, ``samples``: :class:`.attached.Ends` of
    the shared samples, both attached; ``confocal``: each scanned point is the spot itself, else there is one for all.

    A plain class, which Dr.Jit loops leave alone.
    """

    def __init__(self, scene: Any, film: Any, light: Any, samples: Ends, confocal: bool) -> None:
        self.scene, self.film, self.samples, self.confocal = scene, film, samples, confocal
        with dr.resume_grad():
            self.sensors, self.spots = Ends.of_points(light.sensors), Ends.of_points(light.spots, light.energy)
        self.match = ChannelMatch(None, mi.UnpolarizedSpectrum(1))
        self.window = film.arrivals()
        self.lit = None if confocal else self._lit()
        # In memory, so that kernels do not depend on them.
        self.sample_count = dr.opaque(mi.UInt32, samples.width)
        self.point_count = dr.opaque(mi.UInt32, self.sensors.width)

    def _lit(self) -> Any:
        """Which samples the single spot reaches, by one ray each."""
        sample, spot = self.samples.take(dr.arange(mi.UInt32, self.samples.width)), self.spots.take(mi.UInt32(0))
        light = three_bounces(sample, spot, spot, confocal=True)
        lit = light.active & ~occluded(self.scene, sample, light.lit, spot.p, spot.n, light.active)
        dr.eval(lit)
        return lit

    def connection(self, sample: Any, point: Any, spot: Any, k: Any, active: Any) -> tuple[Any, Any, Any]:
        """(:class:`.attached.Light` of sample ``k``, arrival minus the film's start, whether it arrives)."""
        light = three_bounces(sample, point, spot, self.confocal)
        opl = mi.Float64(dr.detach(light.length)) - self.film.start_opl
        active = active & light.active
        if self.lit is not None:
            active &= dr.gather(mi.Mask, self.lit, k, active)
        if self.window is not None:
            active &= self.window.counts(opl)
        with dr.suspend_grad():
            from_sample, line = (Local(**{n: dr.detach(v) for n, v in vars(x).items()}) for x in (sample, light.seen))
            active &= ~occluded(self.scene, from_sample, line, dr.detach(point.p), dr.detach(point.n), active)
        return light, opl, active

    # ------------------------------------------------------------------------------------------------- reverse

    def tables(self) -> list[Any]:
        """The attached fields of samples, points and spots."""
        with dr.resume_grad():
            return [ends.fields[name] for ends in self._ends().values() for name in ends.attached]

    def backward(self, incoming: Any) -> None:
        """Hand ``<incoming adjoint, capture>`` on to the scene."""
        read = AdjointReader(self.film, self.match, incoming)
        with dr.resume_grad():  # the question whether a field is attached is answered no while suspended
            at_sample, at_point, at_spot = ([(k, n) for n in ends.attached] for k, ends in self._ends().items())
        (at_point if self.confocal else at_sample).extend(at_spot)
        found: dict[tuple[str, str], Any] = {}
        if at_sample:
            split = Split(self.samples.width, self.sensors.width)
            kept = over_points(self, read, self._zeros(at_sample), split.own, split.first, split.last)
            found |= {key: split.reduced(kept[".".join(key)]) for key in at_sample}
        if at_point:
            split = Split(self.sensors.width, self.samples.width)
            kept = over_samples(self, read, self._zeros(at_point), split.own, split.first, split.last)
            found |= {key: split.reduced(kept[".".join(key)]) for key in at_point}
        dr.eval(found)
        with dr.resume_grad():
            for kind, ends in self._ends().items():
                ends.hand_on({name: value for (of, name), value in found.items() if of == kind})

    def _ends(self) -> dict[str, Ends]:
        return {"sample": self.samples, "point": self.sensors, "spot": self.spots}

    def _zeros(self, wanted: list[tuple[str, str]]) -> dict[str, Any]:
        ends = self._ends()
        return {f"{kind}.{name}": dr.zeros(type(ends[kind].fields[name])) for kind, name in wanted}

    def step_back(self, read: AdjointReader, kept: dict[str, Any], k: Any, s: Any) -> None:
        """Add the adjoints of the connection of sample ``k`` and point ``s`` to ``kept``."""
        width = max(dr.width(k), dr.width(s))
        with dr.resume_grad():
            sample, point, spot = self.samples.take(k), self.sensors.take(s), self._spot(s)
            found = {}
            for kind, local in (("sample", sample), ("point", point), ("spot", spot)):
                names = tuple(key.split(".")[1] for key in kept if key.startswith(kind + "."))
                found |= {f"{kind}.{name}": leaf for name, leaf in leaves(local, names, width).items()}
            light, opl, arrives = self.connection(sample, point, spot, k, mi.Mask(True))
            A, slope = read.block(s).read(opl, arrives)
            objective = total_of(A, light.value) + total_of(slope, dr.detach(light.value)) * slope_only(light.length)
            dr.backward_from(dr.select(arrives, objective, 0))
            for name, leaf in found.items():
                kept[name] = kept[name] + dr.grad(leaf)

    def _spot(self, s: Any) -> Local:
        return self.spots.take(s if self.confocal else mi.UInt32(0))

    # ------------------------------------------------------------------------------------------------- forward

    def forward(self) -> None:
        """Put the derivative along the scene's tangents onto the film."""
        with dr.resume_grad():
            tangents = {kind: ends.tangents() for kind, ends in self._ends().items()}
        launches = launches_of(self.film, self.sensors.width, self.samples.width)
        for launch in launches:
            pixel, first, last = launch.lanes()
            base = launch.base(self.film, pixel)
            block = self.film.create_block(launch, base, self.match, launch.most_events, tangents=True)
            kept = {"dL": mi.UnpolarizedSpectrum(0), "block": block.begin()}
            kept = tangents_over_samples(self, tangents, block, kept, pixel, first, last)
            block.end(kept["block"])
            self.film.add_steady(pixel, self.match.to_channels(kept["dL"]))
            block.finish()
            dr.eval(self.film.bands[launch.band][2], self.film.steady)

    def step_on(self, tangents: dict[str, Ends], block: Any, kept: dict[str, Any], k: Any, s: Any) -> None:
        """Put the derivative of one connection into the film's block."""
        width = max(dr.width(k), dr.width(s))
        with dr.resume_grad():
            sample, point, spot = self.samples.take(k), self.sensors.take(s), self._spot(s)
            at = {"sample": k, "point": s, "spot": s if self.confocal else mi.UInt32(0)}
            for kind, local in (("sample", sample), ("point", point), ("spot", spot)):
                names = tuple(tangents[kind].fields)
                leaves(local, names, width, tangents[kind].take(at[kind]) if names else None)
            light, opl, arrives = self.connection(sample, point, spot, k, mi.Mask(True))
            d_value, d_opl = tangents_of([light.value, slope_only(light.length)])
        value = dr.detach(light.value)
        kept["dL"] = kept["dL"] + dr.select(arrives, d_value, 0)
        block.put_slope(kept["block"], opl, d_value, value * d_opl, arrives)


class Split:
    """Lanes for ``count`` samples or points, several each where there are few, and the range of the ``others`` that
    each of them goes through.
    """

    def __init__(self, count: int, others: int) -> None:
        self.lanes = max(1, min(others, -(-BUSY // count)))
        lanes, size = dr.opaque(mi.UInt32, self.lanes), dr.opaque(mi.UInt32, -(-others // self.lanes))
        lane = dr.arange(mi.UInt32, count * self.lanes)
        self.own = lane // lanes
        self.first = (lane - self.own * lanes) * size
        self.last = dr.minimum(self.first + size, dr.opaque(mi.UInt32, others))
        dr.eval(self.own, self.first, self.last)

    def reduced(self, value: Any) -> Any:
        """Sums over the lanes of one sample or point."""
        if self.lanes == 1:
            return value
        if dr.depth_v(value) == 1:
            return dr.block_sum(value, self.lanes)
        return type(value)(*[dr.block_sum(component, self.lanes) for component in value])


class AdjointReader:
    """The film's adjoint (:class:`~..integrators.incoming_adjoint.IncomingAdjoint`) at scanned points."""

    def __init__(self, film: Any, match: Any, incoming: Any) -> None:
        self.match, self.incoming = match, incoming
        self.width = dr.opaque(mi.UInt32, int(film.crop_size()[0]))

    def block(self, s: Any) -> Any:
        """That of each lane's point, as :class:`~..films.block.AdjointBlock`."""
        row = s // self.width
        place = Local(row=row, column=s - row * self.width, laser=None)
        return self.incoming.block(place, s, self.match)


@dr.syntax
def over_points(job, read, kept, k, first, last):
    """Adjoints of sample ``k`` from the scanned points ``first`` to ``last`` (exclusive)."""
    s = mi.UInt32(first)
    while dr.hint(s < last, label="scanned points, reverse"):
        job.step_back(read, kept, k, s)
        s += 1
    return kept


@dr.syntax
def over_samples(job, read, kept, s, first, last):
    """Adjoints of point ``s`` from the samples ``first`` to ``last`` (exclusive)."""
    k = mi.UInt32(first)
    while dr.hint(k < last, label="hidden samples, reverse"):
        job.step_back(read, kept, k, s)
        k += 1
    return kept


@dr.syntax
def tangents_over_samples(job, tangents, block, kept, s, first, last):
    """Derivatives of what the samples from ``first`` to ``last`` (exclusive) send to point ``s``."""
    k = mi.UInt32(first)
    while dr.hint(k < last, label="hidden samples, forward mode"):
        job.step_on(tangents, block, kept, k, s)
        k += 1
    return kept

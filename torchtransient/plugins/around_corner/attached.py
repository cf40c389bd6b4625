"""Samples and points of the wall with derivatives: what they are of the scene's parameters, and as leaves of a lane."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.around_corner.geometry import occluded, span
from torchtransient.plugins.sampling.packed import packed_columns
from torchtransient.plugins.sampling.shared_samples import material_samples
from torchtransient.plugins.transport.carry import total_of
from torchtransient.plugins.transport.strategy import Local


class Ends:
    """Fields of ``count`` samples or points, by name, attached where the scene is: vectors, spectra and numbers.

    :meth:`load` reads the fields four numbers at a time. A plain object, which Dr.Jit loops leave alone.
    """

    def __init__(self, count: int, fields: dict[str, Any]) -> None:
        self.count, self.fields = count, fields
        self.size = dr.opaque(mi.UInt32, count)
        with dr.suspend_grad():
            columns = [column for value in fields.values() for column in _columns(value)]
            columns += [mi.Float(0)] * (-len(columns) % 4)
            rows = [columns[i : i + 4] for i in range(0, len(columns), 4)]
            self.rows, self.flat = len(rows), packed_columns(rows, count) if rows else None

    @property
    def attached(self) -> list[str]:
        """Names of the fields with derivatives; none are where derivatives are suspended."""
        return [name for name, value in self.fields.items() if dr.grad_enabled(value)]

    def detached(self) -> Ends:
        """The same without derivatives. A virtual call attaches what it returns as soon as any plugin is attached that
        it could have gone to: fields may be attached that nothing moves.
        """
        return Ends(self.count, {name: dr.detach(value) for name, value in self.fields.items()})

    def load(self, index: Any) -> Local:
        """The fields of some of them, without derivatives."""
        rows = [dr.gather(mi.Vector4f, self.flat, index * self.rows + i) for i in range(self.rows)]
        columns = [row[i] for row in rows for i in range(4)]
        found = {}
        for name, value in self.fields.items():
            size = dr.size_v(value) if dr.depth_v(value) > 1 else 1
            own, columns = columns[:size], columns[size:]
            found[name] = type(value)(*own)
        return Local(**found)

    def tangents(self) -> Ends:
        """What forward mode has brought to the attached fields."""
        return Ends(self.count, {name: dr.grad(self.fields[name]) for name in self.attached})

    def hand_on(self, adjoints: dict[str, Any]) -> None:
        """Back-propagate ``<adjoints, fields>``: adjoints by field, of one sample or point each."""
        for name, adjoint in adjoints.items():
            field = self.fields[name]
            if dr.width(field) < self.count:
                adjoint = dr.sum(adjoint) if dr.depth_v(adjoint) == 1 else type(adjoint)(*map(dr.sum, adjoint))
            dr.backward_from(total_of(adjoint, field))


def _columns(value: Any) -> list[Any]:
    return [value] if dr.depth_v(value) == 1 else [value[i] for i in range(dr.size_v(value))]


def leaves(local: Local, names: list[str], width: int, tangents: Local | None = None) -> dict[str, Any]:
    """Make leaves of the fields ``names`` of one sample or point a lane, with ``tangents`` in forward mode."""
    found = {}
    for name in names:
        value = getattr(local, name)
        # As wide as the lanes, or gradients would be summed up over them.
        leaf = type(value)(value + dr.zeros(mi.Float, width))
        dr.enable_grad(leaf)
        if tangents is not None:
            dr.set_grad(leaf, getattr(tangents, name))
        setattr(local, name, leaf)
        found[name] = leaf
    return found


def ends_of_samples(scene: Any, elements: Any, samples: Any, meshes: Any, laser: Any = None) -> Ends:
    """Shared samples as material points: ``p``, ``n``, ``front`` and ``back`` (what the sides scatter of light, times
    the area that a sample stands for), and ``geometric_n`` where normals are interpolated.

    ``laser`` (:class:`.wall_points.WallPoints` of one point): the spot that lights them all. ``n`` then points to the
    side that is lit, ``front`` holds what arrives there, and ``delay`` is the length of the way to the spot.
    """
    found = material_samples(elements, samples, meshes)
    fields = {"p": found.p, "n": found.n, "front": found.front}
    if laser is None:
        fields["back"] = found.back
    else:
        start, n = _line_start(found, samples.smooth), mi.Vector3f(laser.n)
        line = span(start, laser.p, n)
        arrives = dr.abs(line.cos) * line.wall_cos * line.inverse_square
        reflected = dr.select(line.cos > 0, found.front, found.back)
        with dr.suspend_grad():
            lit = arrives > 0
            lit &= ~occluded(scene, start, line, laser.p, n, lit)
        fields["n"] = dr.select(line.cos > 0, found.n, -found.n)
        fields["front"] = dr.select(lit, reflected * arrives, 0)
        fields["delay"] = dr.select(lit, line.r, 0)
    if samples.smooth:
        fields["geometric_n"] = found.geometric_n
    return Ends(samples.count, fields)


def _line_start(sample: Local, smooth: bool) -> Local:
    return Local(p=sample.p, n=sample.n, geometric_n=sample.geometric_n if smooth else sample.n)


def ends_of_points(sensors: Any, lasers: Any, energy: Any) -> Ends:
    """Scanned points with what the wall makes of light there and at the spot, times the laser's energy (``value``), and
    the legs before and behind (``leg``).
    """
    value = mi.UnpolarizedSpectrum(sensors.value * lasers.value * energy)
    leg = mi.Float(sensors.leg) + mi.Float(lasers.leg)
    return Ends(sensors.width, {"p": sensors.p, "n": mi.Vector3f(sensors.n), "value": value, "leg": leg})

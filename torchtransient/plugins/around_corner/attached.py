"""Samples, scanned points and laser spots with derivatives: what they are of the scene's parameters, and as leaves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.around_corner.geometry import span
from torchtransient.plugins.sampling.shared_samples import material_samples
from torchtransient.plugins.transport.carry import total_of
from torchtransient.plugins.transport.strategy import Local

# What a sample and a point of the wall are made of, see :func:`three_bounces`.
SAMPLE = ("p", "n", "geometric_n", "front", "back")
POINT = ("p", "n", "value", "leg")


class Ends:
    """Fields of many samples or points, by name: arrays of one width, attached where the scene is. A plain object."""

    def __init__(self, fields: dict[str, Any]) -> None:
        self.fields = fields
        self.width = max((dr.width(value) for value in fields.values()), default=0)

    @staticmethod
    def of_samples(elements: Any, samples: Any, meshes: Any) -> Ends:
        """The shared samples as material points of their shapes: what each stands for grows with its area."""
        found = material_samples(elements, samples, meshes)
        return Ends({name: getattr(found, name) for name in SAMPLE if samples.smooth or name != "geometric_n"})

    @staticmethod
    def of_points(points: Any, energy: Any = 1) -> Ends:
        """Scanned points, or laser spots with their ``energy``."""
        value, leg = mi.UnpolarizedSpectrum(points.value * energy), mi.Float(points.leg)
        return Ends({"p": points.p, "n": mi.Vector3f(points.n), "value": value, "leg": leg})

    @property
    def attached(self) -> tuple[str, ...]:
        """The fields with derivatives."""
        return tuple(name for name, value in self.fields.items() if dr.grad_enabled(value))

    def take(self, index: Any, active: Any = True) -> Local:
        """The fields of some of them, without derivatives."""
        return Local(**{name: _taken(dr.detach(value), index, active) for name, value in self.fields.items()})

    def tangents(self) -> Ends:
        """Those that forward mode has brought to the fields."""
        return Ends({name: dr.grad(self.fields[name]) for name in self.attached})

    def hand_on(self, adjoints: dict[str, Any]) -> None:
        """Back-propagate ``<adjoints, fields>``: adjoints of fields by name, of one sample or point each."""
        for name, adjoint in adjoints.items():
            field = self.fields[name]
            if dr.width(field) < dr.width(adjoint):
                adjoint = type(adjoint)(dr.sum(adjoint, axis=-1)) if dr.depth_v(adjoint) > 1 else dr.sum(adjoint)
            dr.backward_from(total_of(adjoint, field))


def _taken(value: Any, index: Any, active: Any) -> Any:
    return dr.gather(type(value), value, index if dr.width(value) > 1 else mi.UInt32(0), active)


def leaves(local: Local, names: tuple[str, ...], width: int, tangents: Local | None = None) -> dict[str, Any]:
    """Make leaves of the fields ``names`` of one sample or point each lane; returns them."""
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


@dataclass
class Light:
    """Light of three bounces: ``value``, ``length`` (m), ``active`` (before it is asked what stands in between), and
    the lines to the scanned point and to the spot.
    """

    value: Any
    length: Any
    active: Any
    seen: Any
    lit: Any


def three_bounces(sample: Local, point: Local, spot: Local, confocal: bool) -> Light:
    """What a hidden sample sends from a spot to a scanned point; ``sample.front``, ``back``: albedo over pi of its
    sides, times the area that it stands for; ``spot.value``: with the laser's energy.
    """
    if not hasattr(sample, "geometric_n"):
        sample.geometric_n = sample.n
    seen = span(sample, point.p, point.n)
    if confocal:
        lit, length = seen, 2 * seen.r
    else:
        lit = span(sample, spot.p, spot.n)
        length = seen.r + lit.r
    scattered = dr.select(lit.cos > 0, sample.front, sample.back)
    g = dr.abs(lit.cos) * lit.wall_cos * lit.inverse_square
    g = g * dr.abs(seen.geometric_cos) * seen.wall_cos * seen.inverse_square
    active = (dr.detach(g) > 0) & (dr.detach(lit.cos * seen.cos) > 0)
    value = scattered * g * point.value * spot.value
    return Light(value, length + point.leg + spot.leg, active, seen, lit)

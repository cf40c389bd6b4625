"""What is changed of a description when it is built."""

from __future__ import annotations

from dataclasses import dataclass

from torchtransient.pulses import Pulse
from torchtransient.rendering.films import FilmLayout


@dataclass(frozen=True)
class BuildOptions:
    """What is changed of a description when it is built.

    ``film``: what every film becomes, None to keep them. ``max_depth``: for the integrator, or None. ``substitute``:
    BSDFs that are built as their differentiable twins, by name, with the texture that is asked for or "".
    ``real_bitmaps``: store every bitmap as real numbers;
    Mitsuba keeps 8-bit images in 8 bits, which have no derivative. ``merge``: let Mitsuba merge meshes and equal
    materials, which is faster to trace but takes parameters away. ``transient``: turn a steady film and integrator into
    transient ones. ``sampler``: plugin name of a sampler that replaces those of the sensors, with the same number of
    samples; None to keep them. ``pulse``, ``irf``: shape of the light's pulse and impulse response of the sensor for
    every film, None to keep what the films have. ``integrator``: plugin name of a transient integrator that replaces
    the scene's, with the parameters that both have; None to keep it. ``steady``: False takes the steady image from the
    histograms.
    """

    film: FilmLayout | None = None
    max_depth: int | None = None
    substitute: frozenset[tuple[str, str]] = frozenset()
    real_bitmaps: bool = False
    merge: bool = False
    transient: bool = False
    sampler: str | None = None
    pulse: Pulse | None = None
    irf: Pulse | None = None
    steady: bool = True
    integrator: str | None = None

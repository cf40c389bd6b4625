"""Gradient cases of the light's colour and time: response curves of the film, pulses, gates, delays."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from support.gradient_cases.problem import Case
from support.gradient_cases.scenes import area_light, camera, film, room
from support.gradient_cases.unknowns import move, set_color

BANDS = {
    "red": {"type": "regular", "wavelength_min": 550, "wavelength_max": 750, "values": "0, 1, 0.2, 0"},
    "blue": {"type": "spectrum", "value": [(400, 0.0), (450, 1.0), (500, 0.0)]},
}


def spectrum(values):
    """A spectrum over the visible range with some values at equal distances."""
    return {"type": "regular", "wavelength_min": 360, "wavelength_max": 830, "values": values}


def banded_room(**arguments):
    """The room seen by a film with response curves."""
    sensor = camera()
    sensor["film"] = {**film(), **BANDS}
    return room(sensor=sensor, **arguments)


def measured_panel():
    """A panel whose reflectance is a measured spectrum."""
    scene = banded_room()
    scene["side"]["bsdf"] = {"type": "diffuse", "reflectance": spectrum("0.2, 0.6, 0.4")}
    return scene


def coloured_lamp():
    """A point light with a measured spectrum."""
    return banded_room(light={"type": "point", "position": [0.5, 0.0, 4.0], "intensity": spectrum("2, 9, 4, 6")})


def tilt_spectrum(key):
    """Add ``x`` to the longer half of a tabulated spectrum."""

    def apply(params, x):
        values = params[key]
        n = dr.width(values)
        ramp = dr.select(dr.arange(mi.UInt32, n) >= n // 2, mi.Float(1), 0)
        params[key] = type(values)(mi.Float(values) + ramp * x)

    return apply


def pulsed_room(**properties):
    """The room with a film that spreads arrivals; the box filter takes its slope from the pulse."""
    sensor = camera()
    sensor["film"] = {**film(filter="box"), **properties}
    return room(sensor=sensor)


def gated_room(**properties):
    """The room seen through three gates with slopes."""
    sensor = camera()
    sensor["film"] = {**GATED_FILM, **properties}
    return room(sensor=sensor)


DIFFUSE = {"type": "diffuse", "reflectance": 0.5}
LATE = {"type": "delayed", "lifetime": 0.4, "quantum_yield": 0.7, "nested": DIFFUSE}
LATE_SIDE = {**LATE, "lifetime": 0.3, "nested": {"type": "diffuse", "reflectance": 0.8}}


def late_room(bsdf, **arguments):
    """The room with a delayed wall and a delayed panel, long enough for the delays."""
    scene = room(bsdf=bsdf, sensor=camera(bins=400), **arguments)
    scene["side"]["bsdf"] = LATE_SIDE
    return scene


def fluorescent_room():
    """A wall that turns blue light to green, seen by a film with response curves."""
    shift = {"excitation": spectrum("0.9, 0.5, 0, 0"), "emission": spectrum("0, 1, 1, 0.2")}
    scene = banded_room()
    scene["wall"]["bsdf"] = {**LATE, **shift, "elastic": {"type": "diffuse", "reflectance": 0.3}}
    scene["sensor"]["film"]["temporal_bins"] = 400
    return scene


GATED_FILM = {
    "type": "gated_hdr_film",
    "gates": "gaussian 8.0 0.15; tabulated 7.9:0 8.2:1 8.8:0; gaussian 8.9 0.3",
    "width": 4,
    "height": 4,
    "rfilter": {"type": "box"},
}

CASES = [
    Case(
        "banded_albedo_spectrum",
        "measured spectra, response curves",
        measured_panel,
        tilt_spectrum("side.bsdf.reflectance.values"),
        0.0,
        0.02,
        "llvm_ad_spectral",
        2048,
    ),
    Case(
        "banded_lamp_spectrum",
        "measured spectra, response curves",
        coloured_lamp,
        tilt_spectrum("light.intensity.values"),
        0.0,
        0.2,
        "llvm_ad_spectral",
        2048,
    ),
    Case(
        "wall_under_long_pulse",
        "shape to_world, pulse of the light",
        lambda: pulsed_room(
            pulse="tabulated", pulse_opl="-0.2, 0, 0.7", pulse_values="0 1 0", irf="gaussian", irf_fwhm_opl=0.3
        ),
        move("wall.to_world", (0, 0, 1)),
        0.0,
        2e-3,
        spp=2048,
    ),
    Case("gated_wall", "shape to_world, time gates", gated_room, move("wall.to_world", (0, 0, 1)), 0.0, 5e-4, spp=2048),
    Case(
        "gated_side_albedo",
        "diffuse albedo, time gates",
        lambda: gated_room(pulse="rectangular", pulse_width_opl=0.2),
        set_color("side.bsdf.reflectance.value"),
        0.8,
        0.02,
        spp=2048,
    ),
    Case(
        "lifetime",
        "lifetime of a delayed BSDF",
        lambda: late_room(LATE),
        set_color("wall.bsdf.lifetime"),
        0.4,
        5e-3,
        spp=4096,
    ),
    Case(
        "lifetime_of_a_measured_decay",
        "lifetime of a delayed BSDF",
        lambda: late_room({**LATE, "decay_opl": "0 0.1 1", "decay_values": "0 1 0", "elastic_fraction": 0.3}),
        set_color("wall.bsdf.lifetime"),
        0.4,
        5e-3,
        spp=4096,
    ),
    Case(
        "quantum_yield",
        "quantum yield of a delayed BSDF",
        lambda: late_room({**LATE, "elastic": {"type": "roughconductor", "alpha": 0.3}}),
        set_color("side.bsdf.quantum_yield"),
        0.7,
        0.05,
        spp=8192,
    ),
    Case(
        "elastic_fraction",
        "elastic fraction of a delayed BSDF",
        lambda: late_room({**LATE, "elastic_fraction": 0.4}),
        set_color("wall.bsdf.elastic_fraction"),
        0.4,
        0.02,
        spp=4096,
    ),
    Case(
        "albedo_inside_a_delay",
        "diffuse albedo",
        lambda: late_room({**LATE, "elastic_fraction": 0.4}),
        set_color("wall.bsdf.nested.reflectance.value"),
        0.5,
        0.02,
        spp=4096,
    ),
    Case(
        "area_light_over_a_delayed_wall_moves",
        "area light shape",
        lambda: late_room({**LATE, "elastic_fraction": 0.4}, light=area_light()),
        move("light.to_world", (0.2, 0.1, 1)),
        0.0,
        5e-3,
        spp=32768,
    ),
    Case(
        "polarized_lifetime",
        "lifetime of a delayed BSDF",
        lambda: late_room({**LATE, "elastic": {"type": "roughconductor", "alpha": 0.3}}, light=area_light()),
        set_color("wall.bsdf.lifetime"),
        0.4,
        5e-3,
        "llvm_ad_mono_polarized",
        8192,
    ),
    Case(
        "polarized_fluorescent_yield",
        "quantum yield of a delayed BSDF",
        fluorescent_room,
        set_color("wall.bsdf.quantum_yield"),
        0.7,
        0.05,
        "llvm_ad_spectral_polarized",
        8192,
        fd_spp=32768,
    ),
]

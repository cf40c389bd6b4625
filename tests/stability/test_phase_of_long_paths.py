"""Phases of short wavelengths after long paths."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.film_storage import storage

VARIANT = "llvm_ad_mono"
WAVELENGTHS = [0.1, 0.01, 0.0015]
CYCLES = 1e-4


def film_of(frequencies, **arguments):
    return {
        "type": "phasor_hdr_film",
        "width": 1,
        "height": 1,
        "rfilter": {"type": "box"},
        "frequencies": " ".join(repr(float(f)) for f in frequencies),
        **arguments,
    }


def error_in_cycles(phasors, turns):
    """Distance between the phase of phasors and minus some turns."""
    rest = np.angle(phasors) / (2 * np.pi) + turns
    return np.abs(rest - np.round(rest))


@pytest.mark.parametrize("opl", [10.0, 100.0, 1000.0])
def test_turns_are_counted_in_double_precision(opl):
    """Guards against phases in single precision: at 1 cm and 1 km they are wrong by 9 % of a cycle, and reducing a
    single-precision phase modulo 2 pi does not help, since its grain is the error.
    """
    film = mi.load_dict(film_of(1 / np.array(WAVELENGTHS)))
    lengths = opl + np.random.default_rng(0).uniform(0, 0.2, 100)
    cube = storage(film, 100 * film.entries_per_pixel())
    base = dr.arange(mi.UInt32, 100) * film.entries_per_pixel()
    film.put(0, base, mi.Float64(lengths), [mi.Float(1)], mi.Bool(True))
    pairs = np.array(cube, dtype=np.float64).reshape(100, -1, 2)
    assert error_in_cycles(pairs[..., 0] + 1j * pairs[..., 1], lengths[:, None] * film.frequencies).max() < 1e-6
    single = (np.float32(lengths)[:, None] * np.float32(film.frequencies)).astype(np.float64)
    assert opl < 1000 or np.abs(single - lengths[:, None] * film.frequencies).max() > 1e-2


@pytest.mark.parametrize("spacing", ["grid", "list"])
def test_a_kilometre_there_and_back(spacing):
    """Guards against lengths or phases that lose their place on the way through the renderer: a kilometre of path whose
    length floats can represent, at wavelengths from 10 m to 1 cm, within 1e-4 cycles.
    """
    frequencies = np.linspace(0.1, 100.0, 301)
    if spacing == "list":
        frequencies = np.sort(np.random.default_rng(1).uniform(0.1, 100.0, 301))
    # Rays so close to the axis that floats hold their lengths, and that of the shadow ray, exactly.
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "transient_path", "max_depth": 2},
            "sensor": {
                "type": "perspective",
                "fov": 1e-5,
                "near_clip": 0.25,
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 512.25], [0, 0, 0], [0, 1, 0]),
                "film": film_of(frequencies),
            },
            "wall": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3)},
            "light": {"type": "point", "position": [0.0, 0.0, 487.875], "intensity": 1e4},
        }
    )
    steady, phasors = scene.integrator().render(scene, spp=16)
    pairs = np.array(phasors, dtype=np.float64).reshape(301, 2)
    total = pairs[:, 0] + 1j * pairs[:, 1]
    assert np.abs(total) == pytest.approx(float(steady.array[0]), rel=1e-5)
    turns = (512.25 + 487.875) * scene.sensors()[0].film().frequencies
    assert error_in_cycles(total, turns).max() < CYCLES

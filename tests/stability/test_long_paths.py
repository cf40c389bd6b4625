"""Optical path lengths of 100 m and 1000 m in bins of a millimetre, and phases of short wavelengths after them."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.film_storage import storage
from support.media_scenes import film, load
from support.runs import T

VARIANT = "llvm_ad_mono"


def pixel(z, film, fov=1e-4, near=0.1):
    """A camera of one pixel at height z that looks down."""
    view = T().look_at([0, 0, z], [0, 0, 0], [0, 1, 0])
    return {"type": "perspective", "fov": fov, "near_clip": near, "far_clip": 1e4, "to_world": view, "film": film}


def wall_and_lamp(height):
    lamp = {"type": "point", "position": [0.0, 0.0, height], "intensity": 1e4}
    return {"wall": {"type": "rectangle", "to_world": T().scale(3)}, "light": lamp}


def test_one_leg_there_and_back():
    """Guards against lengths kept in single precision from the sensor on: at 1000 m their grain is 6e-5 m, and sums of
    them with a start of the window that is not subtracted first are late or early by more than a tenth of a millimetre.
    """
    z = float(np.float32(487.654))
    for late in (0.1, 0.9):  # where in bin 10 the light should arrive
        window = film(1, 1, start=2 * z - (10 + late) * 1e-3, bins=20, bin_width=1e-3)
        scene = load(wall_and_lamp(z), pixel(z, window), "transient_path", max_depth=2)
        steady, transient = scene.integrator().render(scene, spp=64)
        bins = np.array(transient)[0, 0, :, 0]
        assert bins[10] == pytest.approx(float(steady.array[0]), rel=1e-5) and bins[10] > 0


def test_many_legs():
    """Guards against two errors that grow with the number of bounces (1055 m here): sums in single precision, and legs
    measured from ray origins that were lifted off the surface (by 1e-4 m and more) instead of from hit point to hit
    point.

    A slab of glass around z = 0, a camera at z = 2 and a lamp at z = 3. Light that went to and fro in the slab 7 times
    and left towards the camera arrives in the middle of the window: 2 m + 3 m less the slab, and twice the slab per
    order.
    """
    index, order, tolerance, bins = 40.0, 7, 2e-4, 1000
    half = float(np.float32(1.8765 / 2))
    arrival, window = 5 - 2 * half + order * 4 * half * float(np.float32(index)), 100 * tolerance
    # off the axis: a ray that meets the diagonal of a face may slip between two triangles
    place = T().translate([0.03, 0.02, 0]).scale([0.5, 0.5, half])
    objects = {
        "slab": {"type": "cube", "to_world": place, "bsdf": {"type": "dielectric", "int_ior": index, "ext_ior": 1.0}},
        "lamp": {
            "type": "rectangle", "to_world": T().translate([0, 0, 3]).rotate([0, 1, 0], 180).scale(0.2),
            "emitter": {"type": "area", "radiance": 1.0},
        },
    }  # fmt: skip
    sensor = pixel(2, film(1, 1, start=arrival - window / 2, bins=bins, bin_width=window / bins))
    scene = load(objects, sensor, "transient_path", max_depth=2 * order + 3, rr_depth=100000)
    transient = np.array(scene.integrator().render(scene, spp=1 << 17)[1], dtype=float)[0, 0, :, 0]
    R = ((index - 1) / (index + 1)) ** 2
    assert transient.sum() == pytest.approx((1 - R) ** 2 * R ** (2 * order - 1), rel=0.2)
    late = ((np.arange(bins) + 0.5) @ transient / transient.sum() / bins - 0.5) * window
    assert abs(late) < tolerance


# ------------------------------------------------------------------------------------------------------------- phases


def film_of(frequencies):
    text = " ".join(repr(float(f)) for f in frequencies)
    return {"type": "phasor_hdr_film", "width": 1, "height": 1, "rfilter": {"type": "box"}, "frequencies": text}


def error_in_cycles(phasors, turns):
    """Distance between the phase of phasors and minus some turns."""
    rest = np.angle(phasors) / (2 * np.pi) + turns
    return np.abs(rest - np.round(rest))


def test_turns_are_counted_in_double_precision():
    """Guards against phases in single precision: at 1 cm and 1 km they are wrong by 9 % of a cycle, and reducing a
    single-precision phase modulo 2 pi does not help, since its grain is the error.
    """
    film = mi.load_dict(film_of(1 / np.array([0.1, 0.01, 0.0015])))
    lengths = 1000 + np.random.default_rng(0).uniform(0, 0.2, 100)
    cube = storage(film, 100 * film.entries_per_pixel())
    base = dr.arange(mi.UInt32, 100) * film.entries_per_pixel()
    film.put(0, base, mi.Float64(lengths), [mi.Float(1)], mi.Bool(True))
    pairs = np.array(cube, dtype=np.float64).reshape(100, -1, 2)
    assert error_in_cycles(pairs[..., 0] + 1j * pairs[..., 1], lengths[:, None] * film.frequencies).max() < 1e-6
    single = (np.float32(lengths)[:, None] * np.float32(film.frequencies)).astype(np.float64)
    assert np.abs(single - lengths[:, None] * film.frequencies).max() > 1e-2


@pytest.mark.parametrize("spacing", ["grid", "list"])
def test_a_kilometre_there_and_back(spacing):
    """Guards against lengths or phases that lose their place on the way through the renderer: a kilometre of path whose
    length floats can represent, at wavelengths from 10 m to 1 cm, within 1e-4 cycles.
    """
    frequencies = np.linspace(0.1, 100.0, 301)
    if spacing == "list":
        frequencies = np.sort(np.random.default_rng(1).uniform(0.1, 100.0, 301))
    # Rays so close to the axis that floats hold their lengths, and that of the shadow ray, exactly.
    sensor = pixel(512.25, film_of(frequencies), fov=1e-5, near=0.25)
    scene = load(wall_and_lamp(487.875), sensor, "transient_path", max_depth=2)
    steady, phasors = scene.integrator().render(scene, spp=16)
    pairs = np.array(phasors, dtype=np.float64).reshape(301, 2)
    total = pairs[:, 0] + 1j * pairs[:, 1]
    assert np.abs(total) == pytest.approx(float(steady.array[0]), rel=1e-5)
    turns = (512.25 + 487.875) * scene.sensors()[0].film().frequencies
    assert error_in_cycles(total, turns).max() < 1e-4

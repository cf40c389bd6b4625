"""Optical path lengths of 100 m and 1000 m in bins of a millimetre."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from support.marks import long_rows

VARIANT = "llvm_ad_mono"


def T():
    return mi.ScalarTransform4f()


def pixel(start, bins, width, filter="box", near=0.1, far=1e4):
    film = {
        "type": "transient_hdr_film",
        "width": 1,
        "height": 1,
        "rfilter": {"type": "box"},
        "temporal_filter": filter,
        "start_opl": start,
        "temporal_bins": bins,
        "bin_width_opl": width,
    }
    return {"type": "perspective", "fov": 1e-4, "near_clip": near, "far_clip": far, "film": film}


def test_one_leg_there_and_back():
    """Guards against lengths kept in single precision from the sensor on: at 1000 m their grain is 6e-5 m, and sums of
    them with a start of the window that is not subtracted first are late or early by more than a tenth of a millimetre.
    """
    z = float(np.float32(487.654))
    for late in (0.1, 0.9):  # where in bin 10 the light should arrive
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "transient_path", "max_depth": 2},
                "sensor": pixel(2 * z - (10 + late) * 1e-3, 20, 1e-3)
                | {"to_world": T().look_at([0, 0, z], [0, 0, 0], [0, 1, 0])},
                "wall": {"type": "rectangle", "to_world": T().scale(3)},
                "light": {"type": "point", "position": [0.0, 0.0, z], "intensity": 1e4},
            }
        )
        steady, transient = scene.integrator().render(scene, spp=64)
        bins = np.array(transient)[0, 0, :, 0]
        assert bins[10] == pytest.approx(float(steady.array[0]), rel=1e-5) and bins[10] > 0


def slab(index, thickness, order, window, bins):
    """A slab of glass around z = 0, a camera at z = 2 and a lamp at z = 3. Light that went to and fro in the slab
    ``order`` times and left towards the camera arrives in the middle of the window: 2 m + 3 m less the slab, and twice
    the slab per order.
    """
    half = float(np.float32(thickness / 2))
    arrival = 5 - 2 * half + order * 4 * half * float(np.float32(index))
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "transient_path", "max_depth": 2 * order + 3, "rr_depth": 100000},
            "sensor": pixel(arrival - window / 2, bins, window / bins)
            | {"to_world": T().look_at([0, 0, 2], [0, 0, 0], [0, 1, 0])},
            # off the axis: a ray that meets the diagonal of a face may slip between two triangles
            "slab": {
                "type": "cube",
                "to_world": T().translate([0.03, 0.02, 0]).scale([0.5, 0.5, half]),
                "bsdf": {"type": "dielectric", "int_ior": index, "ext_ior": 1.0},
            },
            "lamp": {
                "type": "rectangle",
                "to_world": T().translate([0, 0, 3]).rotate([0, 1, 0], 180).scale(0.2),
                "emitter": {"type": "area", "radiance": 1.0},
            },
        }
    )


@pytest.mark.parametrize(
    ("index", "thickness", "order", "tolerance"),
    long_rows([(10.0, 0.1234, 8, 1e-5), (10.0, 0.5432, 10, 2e-5), (40.0, 1.8765, 7, 2e-4)], [(40.0, 1.8765, 7, 2e-4)]),
)
def test_many_legs(index, thickness, order, tolerance):
    """Guards against two errors that grow with the number of bounces (24, 113 and 1055 m here): sums in single
    precision, and legs measured from ray origins that were lifted off the surface (by 1e-4 m and more) instead of from
    hit point to hit point.
    """
    bins = 1000
    scene = slab(index, thickness, order, 100 * tolerance, bins)
    transient = np.array(scene.integrator().render(scene, spp=1 << 17)[1], dtype=float)[0, 0, :, 0]
    R = ((index - 1) / (index + 1)) ** 2
    assert transient.sum() == pytest.approx((1 - R) ** 2 * R ** (2 * order - 1), rel=0.2)
    late = ((np.arange(bins) + 0.5) @ transient / transient.sum() / bins - 0.5) * 100 * tolerance
    assert abs(late) < tolerance

"""The affine helpers against Mitsuba's own transforms."""

import mitsuba as mi
import numpy as np
import pytest

from support.sweeps import together
from torchtransient.errors import SceneError, ShapeError
from torchtransient.scenes import transforms as tf

if mi.variant() is None:
    mi.set_variant("llvm_ad_rgb")


def matrix_of(transform):
    return np.array(transform.matrix, dtype=np.float64)


@pytest.mark.parametrize(
    "ours, theirs",
    [
        (tf.translate([1, -2, 3.5]), lambda t: t.translate([1, -2, 3.5])),
        (tf.scale([0.3, 2, -1]), lambda t: t.scale([0.3, 2, -1])),
        (tf.rotate([0, 1, 0], -17), lambda t: t.rotate([0, 1, 0], -17)),
        (tf.look_at([1, 2, 3], [-1, 0.5, 2], [0, 0, 2]), lambda t: t.look_at([1, 2, 3], [-1, 0.5, 2], [0, 0, 2])),
        (
            tf.translate([1, 2, 3]) @ tf.rotate([0, 0, 1], 30) @ tf.scale([1, 2, 3]),
            lambda t: t.translate([1, 2, 3]).rotate([0, 0, 1], 30).scale([1, 2, 3]),
        ),
    ],
)
def test_agrees_with_mitsuba(ours, theirs):
    assert ours.dtype == np.float64 and ours.shape == (4, 4)
    # Mitsuba's scalar transforms are float32 in this variant: a few ulp of the largest entry
    np.testing.assert_allclose(ours, matrix_of(theirs(mi.ScalarTransform4f())), rtol=0, atol=2e-6)


def test_rotation_about_an_oblique_axis():
    axis = np.array([1.0, 2.0, 2.0]) / 3  # Mitsuba expects a unit axis, ours takes any length
    theirs = matrix_of(mi.ScalarTransform4f().rotate(axis.tolist(), 123))
    np.testing.assert_allclose(tf.rotate([10, 20, 20], 123), theirs, rtol=0, atol=1e-6)


@together("call, error", [
    (lambda: tf.translate([1, 2]), ShapeError), (lambda: tf.translate([1, 2, np.nan]), SceneError),
    (lambda: tf.scale(0), SceneError), (lambda: tf.scale([1, 0, 1]), SceneError),
    (lambda: tf.rotate([0, 0, 0], 10), SceneError), (lambda: tf.look_at([1, 1, 1], [1, 1, 1]), SceneError),
    (lambda: tf.look_at([0, 0, 0], [0, 5, 0]), SceneError),
])  # fmt: skip
def test_what_is_refused(call, error):
    with pytest.raises(error):
        call()

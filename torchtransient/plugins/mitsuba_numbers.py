"""What Mitsuba 3.9.1 makes of installed values in plain numbers, outside of Dr.Jit's sight.

``tests/plugins/test_mitsuba_numbers.py`` shows each on Mitsuba alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from torchtransient.errors import SceneError

# By class and name. The ends of an irregular spectrum are read when it is installed, and become part of the kernels: a
# recorded call would keep those of its own.
_READ_WHEN_INSTALLED = frozenset({("IrregularSpectrum", "wavelengths")})
# These flip their normals at every update with a pose that reflects, instead of once.
_TURNED_BY_REFLECTIONS = frozenset({("Sphere", "to_world"), ("Cylinder", "to_world")})


def is_number_of_kernels(class_name: str, name: str) -> bool:
    """Whether a value becomes plain numbers of kernels, other ones with each value."""
    return (class_name, name) in _READ_WHEN_INSTALLED


def is_turned_by_reflections(class_name: str, name: str) -> bool:
    """Whether a pose that reflects turns the shape inside out once more at every installation."""
    return (class_name, name) in _TURNED_BY_REFLECTIONS


def check_pose(key: str, *poses: Any) -> None:
    """Raise SceneError for poses (4, 4) that reflect, of a shape that they would turn inside out."""
    if any(np.linalg.det(np.asarray(pose, dtype=np.float64).reshape(4, 4)[:3, :3]) < 0 for pose in poses):
        raise SceneError(
            f"value of {key!r}: expected poses without a reflection, got one whose determinant is negative: Mitsuba "
            "turns such a shape inside out once more at every change. Turn it by a rotation, use flip_normals, or "
            "describe it as a mesh."
        )

"""Rigid motion of constant velocity."""

from __future__ import annotations

import torch
from torch import Tensor

from torchtransient.checks import Numbers, shown
from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import holds
from torchtransient.scene.values import as_float


class Motion:
    """Rigid motion of constant velocity: a point p has the velocity `linear + angular x (p - center)` at t = 0.

    The center moves along with `linear`, and the body turns about it. Tensors keep their gradients.

    Args:
        linear: velocity of the center, (3,), m/s, in the world.
        angular: axis times angle per second, right-handed, (3,), rad/s, in the world.
        center: point that the body turns about, where it is at t = 0, (3,), metres, in the world.

    Raises:
        ShapeError: unless each has three numbers.
        UnitError: for numbers that are not finite.

    Not supported: acceleration; a function of time in place of a motion has any.
    """

    def __init__(
        self,
        *,
        linear: Numbers = (0.0, 0.0, 0.0),
        angular: Numbers = (0.0, 0.0, 0.0),
        center: Numbers = (0.0, 0.0, 0.0),
    ) -> None:
        self.linear, self.angular = _three("linear", linear), _three("angular", angular)
        self.center = _three("center", center)

    def matrices(self, time_s: Tensor) -> Tensor:
        """Return the transforms that take points of t = 0 to their places at other times.

        Args:
            time_s: times, (K,), seconds.

        Returns:
            Matrices (K, 4, 4), float64, to be multiplied with `to_world` from the left; the identity at t = 0.
        """
        time = time_s.double()
        linear, angular, center = (x.to(time) for x in (self.linear, self.angular, self.center))
        x, y, z = angular.unbind()
        zero = torch.zeros_like(x)
        cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
        # Its derivatives at no rotation are right, unlike those of a quotient by the angle.
        turn = torch.matrix_exp(time[:, None, None] * cross)
        shift = linear * time[:, None] + center - turn @ center
        last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=time.dtype, device=time.device).expand(len(time), 1, 4)
        return torch.cat([torch.cat([turn, shift[..., None]], -1), last], -2)

    def __repr__(self) -> str:
        parts = ", ".join(f"{name}={shown(getattr(self, name))}" for name in ("linear", "angular", "center"))
        return f"Motion({parts})"


def _three(name: str, value: Numbers) -> Tensor:
    found = as_float(name, value, value.device.type if isinstance(value, Tensor) else "cpu")
    if found.shape != (3,):
        raise ShapeError(f"Motion: expected {name} as three numbers, got shape {tuple(found.shape)}.")
    if not holds(found.isfinite()):
        raise UnitError(f"Motion: expected finite numbers as {name}, got {shown(value)}.")
    return found

"""Pixels of an image that are different detectors: maps of dead times, gates, afterpulses."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from torchtransient.checks import several
from torchtransient.errors import ArgumentError, GradientError, ShapeError, UnitError
from torchtransient.sensing.base.layout import check_transient
from torchtransient.sensing.base.policies import GradPolicy, ScoreFunction, check_policy, record_score
from torchtransient.sensing.base.sensor import RandomSensor, Sensor, common_bins
from torchtransient.sensing.base.wrapped_detector import added
from torchtransient.sensing.chain.chain_walk import (
    check_draws,
    draw_of,
    draws,
    mean_of,
    measurement_of,
    normal_of,
    policies_of,
)

_MOST_GROUPS = 256


class PixelGroups(RandomSensor):
    """An image (..., C, T, H, W) whose pixels go to different sensors: pixel (i, j) to `sensors[which[i, j]]`.

    For everything that is one number in a sensor and differs from pixel to pixel: dead times (`by_value`), gates,
    afterpulses. Sensors, chains of them (`Compose`) too, have to treat pixels alone (no lenses, no crosstalk) and give
    equal numbers of bins. Costs a call for each sensor. `which`: (H, W) whole numbers; draws, normal surrogates, scores
    and policies are those of the sensors, and `grad` sets all of theirs. Raises ShapeError for other images and for
    numbers that are no sensor's, GradientError for a `variance` or `log_prob` that a sensor has not.
    """

    which: Tensor

    def __init__(self, sensors: Sequence[Sensor], which: Tensor, *, grad: GradPolicy | None = None) -> None:
        super(RandomSensor, self).__init__()
        sensors = several("PixelGroups", sensors, "sensors", error=ArgumentError)
        wrong = [type(s).__name__ for s in sensors if not isinstance(s, Sensor)]
        if not len(sensors) or wrong:
            raise ArgumentError(f"PixelGroups: expected a list of sensors, got {wrong or 'an empty one'}.")
        if not isinstance(which, Tensor) or which.ndim != 2 or which.is_complex():
            shape = tuple(which.shape) if isinstance(which, Tensor) else type(which).__name__
            raise ShapeError(f"PixelGroups: expected which as (H, W) numbers of sensors, got {shape}.")
        numbers = which.long()
        inside = (numbers == which) & (numbers >= 0) & (numbers < len(sensors))
        if not bool(inside.all()):
            raise ShapeError(f"PixelGroups: expected numbers of {len(sensors)} sensors, 0 to {len(sensors) - 1}.")
        check_draws(sensors, "PixelGroups")
        self.sensors = nn.ModuleList(sensors)
        self.register_buffer("which", numbers)
        self.takes, self.gives = sensors[0].takes, sensors[0].gives
        if any((s.takes, s.gives) != (self.takes, self.gives) for s in sensors):
            raise UnitError("PixelGroups: expected sensors that take and give the same, got different kinds of light.")
        self.bin_width_s, self.num_bins = common_bins(sensors, "PixelGroups")
        if grad is not None:
            self.grad = grad

    @classmethod
    def by_value(
        cls, values: Tensor, make: Callable[[float], Sensor], *, grad: GradPolicy | None = None
    ) -> PixelGroups:
        """One sensor `make(value)` for each of the numbers of a map (H, W): dead times in seconds, say.

        At most 256 different ones (UnitError): round maps that have more, to a tenth of a bin for instance.
        """
        if not isinstance(values, Tensor) or values.ndim != 2:
            raise ShapeError("PixelGroups.by_value: expected a map (H, W), got something else.")
        different, which = torch.unique(values.double(), return_inverse=True)
        if different.numel() > _MOST_GROUPS:
            raise UnitError(
                f"PixelGroups.by_value: expected at most {_MOST_GROUPS} different values, got {different.numel()}. "
                "Round the map, to a tenth of a bin for instance."
            )
        return cls([make(value) for value in different.tolist()], which, grad=grad)

    @property
    def grad(self) -> GradPolicy:
        """The policy of all random sensors. GradientError where they have different ones."""
        policies = policies_of(self)
        if len(policies) > 1:
            raise ArgumentError(f"PixelGroups: expected one policy of all sensors, got {sorted(policies)}. Set grad.")
        return policies.pop() if policies else "expected"

    @grad.setter
    def grad(self, value: GradPolicy) -> None:
        policy = check_policy(value, "PixelGroups")
        for part in self.sensors.modules():
            if isinstance(part, RandomSensor):
                part.grad = policy

    def check_bins(self, x: object) -> None:
        super().check_bins(x)
        for sensor in self.sensors:
            if isinstance(sensor, Sensor):
                sensor.check_bins(x)

    def _apart(self, x: Tensor) -> list[tuple[Sensor, Tensor]]:
        """Sensors with their pixels' places in a flat image."""
        check_transient(x, "PixelGroups")
        if self.which.shape != x.shape[-2:]:
            raise ShapeError(
                f"PixelGroups: expected an image {tuple(self.which.shape)} as in which, got {tuple(x.shape[-2:])}. "
                "Make the map for this sensor."
            )
        flat = self.which.flatten()
        places = [(s, (flat == i).nonzero().squeeze(-1)) for i, s in enumerate(self.sensors)]
        return [(s, place) for s, place in places if isinstance(s, Sensor) and place.numel()]

    def _measured(self, x: Tensor, measure: Callable[[Sensor, Tensor], Tensor]) -> Tensor:
        """What the sensors make of their own pixels, put together again."""
        parts, places = [], []
        for sensor, place in self._apart(x):
            own = x.flatten(-2).index_select(-1, place).unsqueeze(-2)
            parts.append(measure(sensor, own).squeeze(-2))
            places.append(place)
        if not parts:  # an image without pixels
            return x
        return self._together(parts, places)

    def _together(self, parts: list[Tensor], places: list[Tensor]) -> Tensor:
        """Flat pixels (..., P) of several groups as an image (..., H, W)."""
        lengths = {part.shape[:-1] for part in parts}
        if len(lengths) > 1:
            raise ShapeError(f"PixelGroups: expected sensors that give equal bins, got {sorted(map(tuple, lengths))}.")
        order = torch.cat(places).argsort()
        flat = torch.cat(parts, -1).index_select(-1, order)
        return flat.reshape(*flat.shape[:-1], *self.which.shape)

    def probabilities(self, x: Tensor) -> Tensor:
        """Expected detections per cycle and bin, of detectors."""
        return self._measured(x, lambda sensor, own: sensor.probabilities(own))  # type: ignore[operator]

    def expected(self, x: Tensor) -> Tensor:
        return self._measured(x, mean_of)

    def variance(self, x: Tensor) -> Tensor:
        def spread(sensor: Sensor, own: Tensor) -> Tensor:
            result: Tensor = sensor.variance(own) if draws(sensor) else torch.zeros_like(sensor.expected(own))  # type: ignore[operator]
            return result

        return self._measured(x, spread)

    def gaussian(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """The normal surrogates of the sensors, with their covariance between bins."""
        return self._measured(x, lambda sensor, own: normal_of(sensor, own, generator))

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        with torch.no_grad():
            return self._measured(x, lambda sensor, own: draw_of(sensor, own, generator))

    def log_prob(self, measurement: Tensor, x: Tensor) -> Tensor:
        parts, places = [], []
        for sensor, place in self._apart(x):
            if not draws(sensor):
                raise GradientError(f"PixelGroups.log_prob: expected random sensors, got {type(sensor).__name__}.")
            seen, own = (v.flatten(-2).index_select(-1, place).unsqueeze(-2) for v in (measurement, x))
            parts.append(sensor.log_prob(seen, own).squeeze(-2))  # type: ignore[operator]
            places.append(place)
        return self._together(parts, places)

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """The measurement, every sensor under its own policy and with the same generator in turn."""
        scores: list[Tensor] = []

        def measure(sensor: Sensor, own: Tensor) -> Tensor:
            with ScoreFunction() as score:
                result = measurement_of(sensor, own, generator)
            pixels = (*own.shape[:-3], own.shape[-1])
            found = [value.squeeze(-2) for value in score._log_probs]
            scores.append(added(found) if found else own.new_zeros(pixels))
            return result

        y = self._measured(x, measure)
        if any(s.requires_grad for s in scores):
            places = [place for _, place in self._apart(x)]
            record_score(lambda: self._together(scores, places), "PixelGroups")
        return y

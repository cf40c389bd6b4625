"""Sensors in a row, after a renderer or inside a data set, and images whose pixels go to different sensors.

First photons of a cycle and the stages that move their time stamps are drawn at once: a cycle has one detection at
most, so that counts whose detections move by themselves are multinomial again, with the moved probabilities: one draw
of `sample_multinomial` instead of one for every place that a detection may go to.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor, nn

from torchtransient.errors import GradientError, ShapeError, UnitError
from torchtransient.sensing.chain.stages import (
    check_axis,
    check_chain,
    check_draws,
    check_window,
    draw_of,
    draws,
    ends_of,
    flat,
    mean_of,
    measurement_of,
)
from torchtransient.sensing.checks import TIME, check_transient, not_a_transient
from torchtransient.sensing.coherent.beats import BeatNoise, CoherentReceiver, Speckle
from torchtransient.sensing.counts import MovedCounts
from torchtransient.sensing.draws import sample_multinomial
from torchtransient.sensing.itof.correlation import ItofCorrelation
from torchtransient.sensing.sensor import (
    GradPolicy,
    RandomSensor,
    ScoreFunction,
    Sensor,
    added,
    check_policy,
    common_bins,
    record_score,
    straight_through,
)
from torchtransient.sensing.spad import SynchronousSPAD, multinomial_noise
from torchtransient.sensing.timing import TDC


def moving_together(stages: Sequence[nn.Module], *, policy: bool) -> tuple[SynchronousSPAD, list[MovedCounts]] | None:
    """Find the SPAD that a chain begins with and the moves behind it, where they can be drawn at once.

    Args:
        stages: stages to call one after another.
        policy: require that all stages have the same gradient policy, and one that draws.

    Returns:
        The SPAD and the moves, or None.
    """
    spad = stages[0]
    if type(spad) is not SynchronousSPAD or spad.dead_bins is not None:
        return None
    moves: list[MovedCounts] = []
    for stage in stages[1:]:
        if not isinstance(stage, MovedCounts) or (isinstance(stage, TDC) and stage.acts_on == "rates"):
            break
        moves.append(stage)
    same = not policy or (spad.grad != "expected" and all(m.grad == spad.grad for m in moves))
    return (spad, moves) if moves and same and not any(_watched(s) for s in (spad, *moves)) else None


def _watched(stage: nn.Module) -> bool:
    """Return True if a stage has hooks on its inputs or outputs."""
    return bool(stage._forward_hooks or stage._forward_pre_hooks or stage._backward_hooks)


def moved_probabilities(spad: SynchronousSPAD, moves: Sequence[MovedCounts], x: Tensor) -> Tensor:
    """Probability of each time stamp in a cycle, in single precision at least.

    Args:
        spad: detector of one detection per cycle.
        moves: stages behind the detector.
        x: rate per cycle and bin, (..., C, T, H, W).
    """
    p = spad.probabilities(x)
    for stage in moves:
        p = stage.expected(p)
    return p


def moved_first_photons(
    spad: SynchronousSPAD,
    moves: Sequence[MovedCounts],
    x: Tensor,
    generator: torch.Generator | None,
    policy: GradPolicy | None = None,
) -> Tensor:
    """Measure light with a SPAD and its moves under a policy.

    Args:
        spad: detector of one detection per cycle.
        moves: stages behind the detector.
        x: rate per cycle and bin, (..., C, T, H, W).
        generator: source of randomness.
        policy: gradient policy; None for a draw without gradient.
    """
    p = moved_probabilities(spad, moves, x)
    if policy == "gaussian":
        return p * spad.cycles + multinomial_noise(p, spad.cycles, generator)
    with torch.no_grad():
        counts = sample_multinomial(spad.cycles, p, generator)
    if policy == "straight_through" and torch.is_grad_enabled():
        counts = straight_through(counts, p * spad.cycles)
    elif policy == "score":
        record_score(lambda: multinomial_log_prob(counts, p, spad.cycles), type(spad).__name__)
    return counts


def multinomial_log_prob(counts: Tensor, probabilities: Tensor, trials: int) -> Tensor:
    """Log-probability of multinomial counts and the trials without one.

    Gradients are finite at probability 0 with count 0; a count there has log-probability -inf.

    Args:
        counts: (..., T, H, W).
        probabilities: (..., T, H, W).
        trials: number of trials.

    Returns:
        (..., H, W), float64.
    """
    n, p = counts.double(), probabilities.double()
    none, rest = trials - n.sum(TIME), 1 - p.sum(TIME)
    value = (n * torch.where((n > 0) | (p > 0), p, 1.0).log()).sum(TIME)
    # probabilities that add up to one leave rounding of either sign
    rest = rest.clamp_min(1e-18)
    counted = torch.lgamma(none + 1) + torch.lgamma(n + 1).sum(TIME)
    return value + none * rest.log() - counted + torch.lgamma(n.new_tensor(trials + 1.0))


# --------------------------------------------------------------------------------------------------------------- chains


class Compose(Sensor):
    """Chain of stages in the order in which light meets them: ``Compose([budget, response, detector])``.

    The input is a transient (..., C, T, H, W), or a renderer's output: its axis is compared with those of the stages, a
    phasor image goes to an `ItofCorrelation` in front, spectra of beats to `Speckle`, `BeatNoise` or
    `CoherentReceiver`.

    ``expected`` hands the mean of each stage to the next: the exact mean where the later stages are linear, else first
    order in the noise. Works as ``transform`` of a data set, in worker processes too; equal generators give equal
    results. A first-photon detector and the `DetectionJitter`, `DetectionSkew` and `TDC` behind it are drawn at once,
    under one policy: the same distribution, in less time. Orders are checked again when a state is loaded.

    Args:
        stages: sensors, or other modules of one tensor; sensors in an ``nn.Sequential`` or an ``nn.ModuleList`` are
            taken one by one.
        grad: gradient policy of every random stage; None leaves them as they are.

    Raises:
        ArgumentError: for a module of another kind with random sensors inside, which cannot be drawn.
        UnitError: where one stage is not made for what those before it give: other bins, another number of cycles,
            another laser period, or another quantity, as the rates of one cycle where the counts of all are meant; and
            for an order in which constant light starves at the ends of the window, or counts are averaged: light's own
            shape, then `PhotonBudget`, the detector, and stages that act on detections.
    """

    def __init__(self, stages: Sequence[nn.Module], *, grad: GradPolicy | None = None) -> None:
        super().__init__()
        self.stages = nn.ModuleList(flat(stages))
        check_draws(self.stages, "Compose")
        self._window_is_open = check_chain(self, self.stages)
        self.takes, self.gives = ends_of(self.stages)  # type: ignore[assignment]
        self.register_load_state_dict_post_hook(_look_again)  # type: ignore[no-untyped-call]
        if grad is not None:
            self.set_grad(grad)

    def set_grad(self, grad: GradPolicy) -> Compose:
        """Use a gradient policy in every random stage, nested ones too.

        Args:
            grad: gradient policy.

        Returns:
            The chain.
        """
        policy = check_policy(grad, "Compose")
        for module in self.modules():
            if isinstance(module, RandomSensor):
                module.grad = policy
        return self

    def expected(self, x: Any) -> Tensor:
        """Mean of the chain, from the means of its stages.

        Args:
            x: light, or a renderer's output.
        """
        return self._run(x, lambda stage, y, _: mean_of(stage, y))

    def forward(self, x: Any, generator: torch.Generator | None = None) -> Tensor:
        """Measure light, every random stage under its own policy and with the same generator in turn.

        Args:
            x: light, or a renderer's output.
            generator: source of randomness.
        """
        return self._run(x, measurement_of, generator, "own")

    def gaussian(self, x: Any, generator: torch.Generator | None = None) -> Tensor:
        """Draw the normal surrogates of all random stages in turn, whatever their policies; differentiable.

        Args:
            x: light, or a renderer's output.
            generator: source of randomness.
        """
        return self._run(x, partial(draw_of, "gaussian"), generator, "gaussian")

    def sample(self, x: Any, generator: torch.Generator | None = None) -> Tensor:
        """Draw every random stage, whatever its policy, without gradient.

        Args:
            x: light, or a renderer's output.
            generator: source of randomness.
        """
        with torch.no_grad():
            return self._run(x, partial(draw_of, "sample"), generator, "draw")

    def variance(self, x: Any) -> Tensor:
        """Variance of every entry, for chains whose last stage alone draws.

        Args:
            x: light, or a renderer's output.

        Raises:
            GradientError: for other chains: draws of several stages have no closed form; `gaussian` has their
                covariance.
        """
        y, stages = self._opened(x)
        if not stages:
            return torch.zeros_like(y)
        *before, last = stages
        if any(draws(stage) for stage in before):
            raise GradientError(
                f"Compose: expected one detector that draws, at the end of the chain, got "
                f"{[type(s).__name__ for s in self.stages]}. variance is not supported for it: draw with sample."
            )
        for stage in before:
            y = mean_of(stage, y)
        if not draws(last):
            return torch.zeros_like(mean_of(last, y))
        result: Tensor = last.variance(y)  # type: ignore[operator]
        return result

    def log_prob(self, measurement: Tensor, x: Any) -> Tensor:
        """Log-probability of a measurement, summed over time, differentiable in the light and the parameters.

        For chains in which one detector draws, behind stages that do not: the `log_prob` of the last stage, or the
        multinomial of a `SynchronousSPAD` of one detection per cycle and the `DetectionJitter` and `TDC` behind it.

        Args:
            measurement: result of `sample`.
            x: light, or a renderer's output.

        Returns:
            (..., C, H, W).

        Raises:
            GradientError: for other chains: draws of several stages have no closed form.
        """
        y, stages = self._opened(x)
        while stages:
            last, found = stages[0], moving_together(stages, policy=False)
            if found is not None and len(found[1]) == len(stages) - 1:
                spad, moves = found
                return multinomial_log_prob(measurement, moved_probabilities(spad, moves, y), spad.cycles)
            if len(stages) == 1 and isinstance(last, (RandomSensor, Compose)):
                return last.log_prob(measurement, y)
            if draws(last):
                break
            y = mean_of(last, y)
            stages = stages[1:]
        raise GradientError(
            f"Compose: expected one detector that draws, at the end of the chain or with nothing but DetectionJitter "
            f"and TDC behind it, got {[type(s).__name__ for s in self.stages]}. log_prob is not supported for it."
        )

    def _run(
        self,
        x: Any,
        step: Callable[[nn.Module, Tensor, torch.Generator | None], Tensor],
        generator: torch.Generator | None = None,
        at_once: Literal["own", "gaussian", "draw"] | None = None,
    ) -> Tensor:
        """Call `step` for one stage after another; first photons and their moves are measured `at_once`."""
        y, stages = self._opened(x)
        if self._window_is_open and y.ndim >= 4:
            check_window(self, y.shape[TIME])
        while stages:
            found = moving_together(stages, policy=at_once == "own") if at_once is not None else None
            if found is None:
                y, stages = step(stages[0], y, generator), stages[1:]
                continue
            spad, moves = found
            policy = spad.grad if at_once == "own" else "gaussian" if at_once == "gaussian" else None
            y, stages = moved_first_photons(spad, moves, y, generator, policy), stages[1 + len(moves) :]
        return y

    def _opened(self, output: Any) -> tuple[Tensor, list[nn.Module]]:
        """Return a tensor, or that of a renderer's output, and the stages that it has not passed yet."""
        stages = list(self.stages)
        if isinstance(output, Tensor):
            return output, stages
        transient, phasor = getattr(output, "transient", None), getattr(output, "phasor", None)
        beats, first = getattr(output, "beats", None), self.stages[0]
        if isinstance(beats, Tensor) and not isinstance(transient, Tensor):
            if isinstance(first, Sensor) and not isinstance(first, (BeatNoise, CoherentReceiver, Speckle)):
                raise ShapeError(
                    f"Compose: expected a transient for {type(first).__name__}, got spectra of beats, which are for "
                    "Speckle, BeatNoise and CoherentReceiver. Render with time_axis=... and without chirps."
                )
            if isinstance(first, CoherentReceiver) and getattr(output, "chirps", None) == first.chirps:
                raise UnitError(
                    "Compose: expected beats without the line of the chirp, which CoherentReceiver makes, got those of "
                    f"{first.chirps}. Render with chirps.longer(16)."
                )
        if isinstance(found := beats if transient is None else transient, Tensor):
            check_axis(self, output.axis)
            return found, stages
        if not isinstance(phasor, Tensor):
            raise ShapeError(
                "Compose: expected a tensor (..., C, T, H, W) or the output of a renderer with a transient, got "
                f"{not_a_transient(output)}"
            )
        if not isinstance(first, ItofCorrelation):
            raise ShapeError(
                f"Compose: expected a transient for {type(first).__name__}, got a phasor image, which ItofCorrelation "
                "alone takes, as the first stage itself, not in a chain. Render with time_axis=... for a transient."
            )
        return first.expected_from_phasor(phasor, output.frequencies, steady=output.steady), stages[1:]


def _look_again(chain: nn.Module, incompatible: object) -> None:
    """Raise UnitError for a loaded state under which the order no longer holds, such as one with a new background."""
    if isinstance(chain, Compose):
        check_chain(chain, chain.stages)


# ------------------------------------------------------------------------------------------ pixels of different sensors


_MOST_GROUPS = 256


class PixelGroups(RandomSensor):
    """Image (..., C, T, H, W) whose pixels go to different sensors: pixel (i, j) to `sensors[which[i, j]]`.

    For everything that is one number in a sensor and differs from pixel to pixel: dead times (`by_value`), gates,
    afterpulses. Costs a call for each sensor. Draws, normal surrogates, scores and policies are those of the sensors.

    Args:
        sensors: sensors, or chains of them (`Compose`), that treat pixels alone (no lenses, no crosstalk) and give
            equal numbers of bins.
        which: (H, W) whole numbers.
        grad: gradient policy of all sensors; None leaves theirs.

    Raises:
        ShapeError: for other images and for numbers that are no sensor's.
        UnitError: for sensors of different quantities or bins.
        GradientError: for a `variance` or `log_prob` that a random sensor has not.
    """

    which: Tensor

    def __init__(self, sensors: Sequence[Sensor], which: Tensor, *, grad: GradPolicy | None = None) -> None:
        super(RandomSensor, self).__init__()
        numbers = which.long()
        inside = (numbers == which) & (numbers >= 0) & (numbers < len(sensors))
        if which.ndim != 2 or not bool(inside.all()):
            raise ShapeError(
                f"PixelGroups: expected which as (H, W) numbers of {len(sensors)} sensors, 0 to {len(sensors) - 1}, "
                f"got {tuple(which.shape)}."
            )
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
        """Make one sensor for each of the numbers of a map: dead times in seconds, say.

        Args:
            values: (H, W), at most 256 different ones: round maps that have more, to a tenth of a bin for instance.
            make: function of a value that makes a sensor.
            grad: gradient policy of all sensors; None leaves theirs.

        Raises:
            UnitError: for more values.
        """
        different, which = torch.unique(values.double(), return_inverse=True)
        if different.numel() > _MOST_GROUPS:
            raise UnitError(
                f"PixelGroups.by_value: expected at most {_MOST_GROUPS} different values, got {different.numel()}. "
                "Round the map, to a tenth of a bin for instance."
            )
        return cls([make(value) for value in different.tolist()], which, grad=grad)

    @property
    def grad(self) -> GradPolicy:
        """Policy of the first random sensor; set, that of all of them."""
        return next((part.grad for part in self.sensors.modules() if isinstance(part, RandomSensor)), "expected")

    @grad.setter
    def grad(self, value: GradPolicy) -> None:
        """Policy of all random sensors."""
        policy = check_policy(value, "PixelGroups")
        for part in self.sensors.modules():
            if isinstance(part, RandomSensor):
                part.grad = policy

    def _apart(self, x: Tensor) -> list[tuple[Sensor, Tensor]]:
        """Return sensors with their pixels' places in a flat image."""
        check_transient(x, "PixelGroups")
        if self.which.shape != x.shape[-2:]:
            raise ShapeError(
                f"PixelGroups: expected an image {tuple(self.which.shape)} as in which, got {tuple(x.shape[-2:])}. "
                "Make the map for this sensor."
            )
        flat = self.which.flatten()
        places = [(s, (flat == i).nonzero().squeeze(-1)) for i, s in enumerate(self.sensors)]
        return [(s, place) for s, place in places if isinstance(s, Sensor) and place.numel()]

    def _measured(self, x: Tensor, measure: Callable[..., Tensor], *others: Tensor) -> Tensor:
        """Measure the pixels of each sensor, and of other images, and put them together again."""
        parts, places = [], []
        for sensor, place in self._apart(x):
            own = [image.flatten(-2).index_select(-1, place).unsqueeze(-2) for image in (x, *others)]
            parts.append(measure(sensor, *own).squeeze(-2))
            places.append(place)
        return self._together(parts, places)

    def _together(self, parts: list[Tensor], places: list[Tensor]) -> Tensor:
        """Put flat pixels (..., P) of several groups together as an image (..., H, W)."""
        lengths = {part.shape[:-1] for part in parts}
        if len(lengths) > 1:
            raise ShapeError(f"PixelGroups: expected sensors that give equal bins, got {sorted(map(tuple, lengths))}.")
        order = torch.cat(places).argsort()
        flat = torch.cat(parts, -1).index_select(-1, order)
        return flat.reshape(*flat.shape[:-1], *self.which.shape)

    def probabilities(self, x: Tensor) -> Tensor:
        """Expected detections per cycle and bin, of detectors.

        Args:
            x: light (..., C, T, H, W).
        """
        return self._measured(x, lambda sensor, own: sensor.probabilities(own))

    def expected(self, x: Tensor) -> Tensor:
        return self._measured(x, mean_of)

    def variance(self, x: Tensor) -> Tensor:
        def spread(sensor: Sensor, own: Tensor) -> Tensor:
            result: Tensor = sensor.variance(own) if draws(sensor) else torch.zeros_like(sensor.expected(own))  # type: ignore[operator]
            return result

        return self._measured(x, spread)

    def gaussian(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Draw the normal surrogates of the sensors, with their covariance between bins.

        Args:
            x: light (..., C, T, H, W).
            generator: source of randomness.
        """
        return self._measured(x, lambda sensor, own: draw_of("gaussian", sensor, own, generator))

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        with torch.no_grad():
            return self._measured(x, lambda sensor, own: draw_of("sample", sensor, own, generator))

    def log_prob(self, measurement: Tensor, x: Tensor) -> Tensor:
        return self._measured(x, lambda sensor, own, seen: sensor.log_prob(seen, own), measurement)

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Measure light, every sensor under its own policy and with the same generator in turn.

        Args:
            x: light (..., C, T, H, W).
            generator: source of randomness.
        """
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

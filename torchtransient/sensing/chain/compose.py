"""Sensors in a row, after a renderer or inside a data set."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.checks import several
from torchtransient.errors import ArgumentError, GradientError, ShapeError, UnitError
from torchtransient.sensing.base.layout import TIME, not_a_transient
from torchtransient.sensing.base.policies import GradPolicy, check_policy
from torchtransient.sensing.base.sensor import RandomSensor, Sensor
from torchtransient.sensing.chain.agreement import check_axis as check_axis
from torchtransient.sensing.chain.agreement import check_stages, check_window
from torchtransient.sensing.chain.chain_order import check_order
from torchtransient.sensing.chain.chain_walk import (
    check_draws,
    draw_of,
    draws,
    ends_of,
    mean_of,
    measurement_of,
    normal_of,
    unrolled,
)
from torchtransient.sensing.chain.first_photon_moves import (
    moved_first_photons,
    moved_probabilities,
    moving_together,
    multinomial_log_prob,
)
from torchtransient.sensing.coherent.beats import BeatNoise, CoherentReceiver, Speckle
from torchtransient.sensing.itof.itof import ItofCorrelation


class Compose(Sensor):
    """Stages in the order in which light meets them: ``Compose([budget, response, detector])``.

    Stages are sensors, or other modules of one tensor; stages in an ``nn.Sequential`` or an ``nn.ModuleList`` are taken
    as if they were given one by one. The input is a transient (..., C, T, H, W), or what a renderer returns (an object
    with ``transient``, ``phasor``, ``beats`` and ``axis``): its axis is compared with those of the stages, a phasor
    image goes to an `ItofCorrelation` in front, spectra of beats to `Speckle`, `BeatNoise` or `CoherentReceiver`.
    ``grad``: set this policy in every random stage; None leaves them as they are.

    ``expected`` hands the mean of each stage to the next: the exact mean where the later stages are linear, else first
    order in the noise. Works as ``transform`` of a data set, in worker processes too; equal generators give equal
    results. A first-photon detector and the `DetectionJitter`, `DetectionSkew` and `TDC` behind it are drawn at once,
    under one policy: the same distribution, in less time. Raises ShapeError for no stage, something that is no module,
    or a module of another kind with random sensors inside, which nobody could draw; UnitError where
    one stage is not made for what those before it give: other bins, another number of cycles, another laser period,
    or another quantity, as the rates of one cycle where the counts of all are meant (see `agreement`); and for an
    order in which constant light starves at the ends of the window, or counts are averaged: light's own shape, then
    `PhotonBudget`, the detector, and what acts on detections. Orders are looked at again when a state is loaded.
    """

    def __init__(self, stages: Sequence[nn.Module], *, grad: GradPolicy | None = None) -> None:
        super().__init__()
        if isinstance(stages, nn.Module) and not isinstance(stages, (nn.Sequential, nn.ModuleList)):
            raise ArgumentError(
                f"Compose: expected a list of sensors, got one {type(stages).__name__}. Put it into []."
            )
        stages = several("Compose", stages, "sensors", error=ArgumentError)
        wrong = [type(s).__name__ for s in stages if not isinstance(s, nn.Module)]
        if not len(stages) or wrong:
            raise ArgumentError(f"Compose: expected a list of sensors, got {wrong or 'an empty one'}.")
        check_draws(stages, "Compose")
        check_order(stages, "Compose")
        self.stages = nn.ModuleList(stages)
        self._window_is_open = check_stages(self)
        self.takes, self.gives = ends_of(stages)  # type: ignore[assignment]
        self.register_load_state_dict_post_hook(_look_again)  # type: ignore[no-untyped-call]
        if grad is not None:
            self.set_grad(grad)

    def set_grad(self, grad: GradPolicy) -> Compose:
        """Use this gradient policy in every random stage, nested ones too; returns the chain."""
        policy = check_policy(grad, "Compose")
        for module in self.modules():
            if isinstance(module, RandomSensor):
                module.grad = policy
        return self

    def expected(self, x: Any) -> Tensor:
        """The chain of the stages' means; see the class."""
        return self._run(x, mean_of)

    def forward(self, x: Any, generator: torch.Generator | None = None) -> Tensor:
        """The measurement, every random stage under its own policy and with the same generator in turn."""

        def at_once(stages: list[nn.Module], y: Tensor) -> tuple[Tensor, int]:
            found = moving_together(stages, policy=True)
            if found is None:
                return y, 0
            spad, moves = found
            return moved_first_photons(spad, moves, y, generator, spad.grad), 1 + len(moves)

        return self._run(x, lambda stage, y: measurement_of(stage, y, generator), at_once)

    def gaussian(self, x: Any, generator: torch.Generator | None = None) -> Tensor:
        """The normal surrogates of all random stages in turn, whatever their policies; differentiable."""

        def at_once(stages: list[nn.Module], y: Tensor) -> tuple[Tensor, int]:
            found = moving_together(stages, policy=False)
            if found is None:
                return y, 0
            spad, moves = found
            return moved_first_photons(spad, moves, y, generator, "gaussian"), 1 + len(moves)

        return self._run(x, lambda stage, y: normal_of(stage, y, generator), at_once)

    def sample(self, x: Any, generator: torch.Generator | None = None) -> Tensor:
        """One draw of every random stage, whatever its policy, without gradient."""

        def at_once(stages: list[nn.Module], y: Tensor) -> tuple[Tensor, int]:
            found = moving_together(stages, policy=False)
            if found is None:
                return y, 0
            spad, moves = found
            return moved_first_photons(spad, moves, y, generator), 1 + len(moves)

        with torch.no_grad():
            return self._run(x, lambda stage, y: draw_of(stage, y, generator), at_once)

    def variance(self, x: Any) -> Tensor:
        """Variance of every entry. For chains that draw nothing, or whose last stage alone does; else GradientError.

        Draws of several stages have no closed form: `sample` tells, and `gaussian` has their covariance.
        """
        y, used = (x, 0) if isinstance(x, Tensor) else self._opened(x)
        stages = unrolled(self.stages)[used:]
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
        """Log-probability of a measurement, time summed: (..., C, H, W), differentiable in `x` and the parameters.

        For chains in which one detector draws, behind stages that do not: the `log_prob` of the last stage, or the
        multinomial of a `SynchronousSPAD` of one detection per cycle and the `DetectionJitter` and `TDC` behind it.
        GradientError for other chains: draws of several stages have no closed form.
        """
        y, used = (x, 0) if isinstance(x, Tensor) else self._opened(x)
        stages = unrolled(self.stages)[used:]
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
        step: Callable[[nn.Module, Tensor], Any],
        at_once: Callable[[list[nn.Module], Tensor], tuple[Tensor, int]] | None = None,
    ) -> Tensor:
        """`step` for one stage after another; `at_once` takes several where it can, and says how many."""
        stages = unrolled(self.stages)
        if isinstance(x, Tensor):
            y = x
        else:
            y, used = self._opened(x)
            stages = stages[used:]
        if self._window_is_open and y.ndim >= 4:
            check_window(self, y.shape[TIME])
        while stages:
            y, used = at_once(stages, y) if at_once is not None else (y, 0)
            if not used:
                y, used = step(stages[0], y), 1
            stages = stages[used:]
        return y

    def _opened(self, output: Any) -> tuple[Tensor, int]:
        """The tensor of a renderer's output, and how many stages it has passed already."""
        transient, phasor = getattr(output, "transient", None), getattr(output, "phasor", None)
        beats = getattr(output, "beats", None)
        if getattr(output, "gates", None) is not None:
            raise ShapeError(
                f"Compose: expected a transient over time, got the images of {len(output.gates)} time gates, which are "
                "no bins. Render with time_axis=... and gate the transient with GatedIntegration; or, for stages that "
                "come after a gate, give the tensor itself: chain(out.gated)."
            )
        if isinstance(transient, Tensor):
            self.check_axis(output.axis)
            return transient, 0
        first = unrolled(self.stages)[0]
        if isinstance(beats, Tensor):
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
            self.check_axis(output.axis)
            return beats, 0
        if isinstance(phasor, Tensor) and isinstance(output.frequencies, FrequencyAxis):
            if isinstance(first, Compose):
                raise ShapeError("Compose: expected ItofCorrelation as the first stage itself, not in a chain.")
            if not isinstance(first, ItofCorrelation):
                raise ShapeError(
                    f"Compose: expected a transient for {type(first).__name__}, got a phasor image, which "
                    "ItofCorrelation alone takes, as the first stage. Render with time_axis=... instead of "
                    "frequencies, or put ItofCorrelation in front."
                )
            return first.expected_from_phasor(phasor, output.frequencies, steady=output.steady), 1
        raise ShapeError(
            "Compose: expected a tensor (..., C, T, H, W) or the output of a renderer with a transient, got "
            f"{not_a_transient(output)}"
        )

    def check_axis(self, axis: TimeAxis) -> None:
        """UnitError when a stage was made for other bins than those of ``axis``, or without an axis."""
        if not isinstance(axis, TimeAxis):
            raise UnitError(f"Compose: expected the transient's time axis, got {axis!r}. Give the tensor itself.")
        check_axis(self, axis)


def _look_again(chain: nn.Module, incompatible: object) -> None:
    """UnitError for a state under which the order no longer holds, such as a background that was not there before."""
    if isinstance(chain, Compose):
        check_order(chain.stages, "Compose")

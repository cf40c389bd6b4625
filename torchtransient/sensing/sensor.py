"""Base classes of sensors, deterministic and random, and the gradient policies of the random ones.

With counts n drawn from a distribution whose mean is m(x), and a loss f:

- `expected`: the value is m, the gradient that of f(m). No noise at all: f(E n) stands for E f(n), which is wrong by
  (1/2) f'' Var n to second order.
- `gaussian`: m + sqrt(v) eps with gradients through m and the variance v. Right for losses up to second order; skewness
  and discreteness are lost, values can be negative, and v near 0 is softened (see `gaussian_noise`).
- `straight_through`: the value is n, the gradient f'(n) dm/dx. Exact for linear losses only: for f = n^2 and Poisson n
  the gradient is short by dm/dx (that of the variance).
- `score`: the value is n, the gradient (f(n) - baseline) d log p(n | x)/dx. Unbiased for every loss, continuous or not;
  high variance, which falls with a baseline. Where m is exactly 0 no count is ever drawn: what the first one would
  change is missing.

`score` needs the value of the loss, which no backward pass knows. It is therefore used through a context:

    with ScoreFunction() as score:
        counts = sensor(x, generator=g)              # a sensor with grad="score", or several in a row
        losses = loss_of(counts)                     # (B,): one number per item, or () or (B, C, H, W)
    score.surrogate(losses, baseline="leave_one_out").mean().backward()

Source: Mohamed et al., Monte Carlo gradient estimation in machine learning, JMLR 21 (2020).
"""

from __future__ import annotations

import contextlib
import copy
import functools
import inspect
import math
from collections.abc import Callable, Iterable, Sequence
from contextvars import ContextVar, Token
from dataclasses import fields, is_dataclass
from types import TracebackType
from typing import Any, Literal, Self, cast, get_args

import torch
from torch import Tensor, nn

from torchtransient.axes import TimeAxis
from torchtransient.errors import ArgumentError, GradientError, ShapeError, TorchTransientError, UnitError
from torchtransient.floating import in_single
from torchtransient.modules import ScalarState
from torchtransient.sensing.checks import TIME, careful_init, check_choice

GradPolicy = Literal["expected", "gaussian", "straight_through", "score"]
GRAD_POLICIES: tuple[GradPolicy, ...] = get_args(GradPolicy)

# Variance (in counts squared) below which the Gaussian surrogate is softened: sqrt has no slope at 0.
VARIANCE_FLOOR = 1e-4

_ACTIVE: ContextVar[tuple[ScoreFunction, ...]] = ContextVar("active_score_functions", default=())


def check_policy(grad: str, where: str) -> GradPolicy:
    """Return `grad` if it is one of GRAD_POLICIES.

    Args:
        grad: any object.
        where: name of the caller, for errors.

    Raises:
        ArgumentError: for anything else.
    """
    check_choice(grad, GradPolicy, "grad", where)
    return cast("GradPolicy", grad)


def standard_normal(like: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Draw standard normal numbers.

    Args:
        like: tensor whose shape, dtype and device they have.
        generator: source of randomness.
    """
    return torch.randn(like.shape, dtype=like.dtype, device=like.device, generator=generator)


@in_single
def gaussian_noise(variance: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Draw normal noise of mean 0 and a given variance, differentiable in the variance.

    The scale is sqrt(v + e) - sqrt(e) with e = VARIANCE_FLOOR: an empty bin stays empty, its gradient is finite (at
    most 50 |eps|), and at v = 1 the variance is 2 % short.

    Args:
        variance: tensor of any shape, counts squared; negative ones (rounding) count as 0.
        generator: source of randomness.

    Returns:
        Shape and dtype of `variance`.
    """
    v = variance.clamp_min(0)
    scale: Tensor = (v + VARIANCE_FLOOR).sqrt() - math.sqrt(VARIANCE_FLOOR)
    return scale * standard_normal(v, generator)


def straight_through(sample: Tensor, mean: Tensor) -> Tensor:
    """Return the values of a sample with the gradient of its mean: exact for losses that are linear in the sample.

    Args:
        sample: drawn values.
        mean: mean of the values; shapes broadcast.
    """
    return sample.detach() + (mean - mean.detach())


class ScoreFunction:
    """Collect log-probabilities of random sensors inside a context, and turn losses into surrogates.

    Sensors in a row add their log-probabilities, each given its own input, so that chains of random sensors are right
    too. Contexts nest; each thread and task has its own. See the example at the top of this file.
    """

    def __init__(self) -> None:
        self._log_probs: list[Tensor] = []
        self._token: Token[tuple[ScoreFunction, ...]] | None = None

    def __enter__(self) -> ScoreFunction:
        self._log_probs.clear()
        self._token = _ACTIVE.set((*_ACTIVE.get(), self))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._token is not None:
            _ACTIVE.reset(self._token)
            self._token = None

    def log_prob(self, shape: tuple[int, ...] | torch.Size) -> Tensor:
        """Sum the collected log-probabilities over all dimensions behind `shape`.

        Args:
            shape: leading dimensions of what was collected, (..., C, H, W).

        Returns:
            Tensor of that shape.

        Raises:
            ShapeError: for a shape that does not begin the shape of what was collected.
            GradientError: if nothing was collected.
        """
        if not self._log_probs:
            raise GradientError(
                "ScoreFunction: no sensor with grad='score' and a differentiable input ran inside the context, so "
                "there is nothing to differentiate. Run the sensor inside the `with` block."
            )
        parts: list[Tensor] = []
        for value in self._log_probs:
            if tuple(value.shape[: len(shape)]) != tuple(shape):
                raise ShapeError(
                    f"ScoreFunction.surrogate: expected losses whose shape begins that of the log-probabilities "
                    f"{tuple(value.shape)}, got {tuple(shape)}. Reduce the losses to one number per item or pixel."
                )
            parts.append(value.reshape((*shape, -1)).sum(-1))
        return functools.reduce(torch.add, parts)

    def surrogate(self, losses: Tensor, baseline: Tensor | float | Literal["leave_one_out"] | None = None) -> Tensor:
        """Return the losses, value unchanged, with an unbiased gradient of their expectation.

        Dependence of the loss on anything else than the draws keeps its ordinary gradient.

        Args:
            losses: one number per item, () or (B,) or as far as (..., C, H, W); an item may depend only on draws that
                share its leading indices (a per-pixel loss behind crosstalk is biased).
            baseline: subtracted from the loss in front of the score: a number, a tensor without dependence on the
                draws, or "leave_one_out", the mean of the other items along dimension 0 (independent items, at least
                2).

        Returns:
            Tensor of the shape of `losses`.

        Raises:
            ShapeError: for losses that do not fit the log-probabilities, or less than two items to leave one out.
            ArgumentError: for another baseline.
            GradientError: if no sensor ran inside the context.
        """
        advantage = losses.detach()
        if isinstance(baseline, str):
            if baseline != "leave_one_out":
                raise ArgumentError(f"ScoreFunction: expected baseline 'leave_one_out' or a number, got {baseline!r}.")
            if losses.ndim == 0 or losses.shape[0] < 2:
                raise ShapeError(
                    f"ScoreFunction: leave_one_out needs at least 2 items along dimension 0, got {tuple(losses.shape)}."
                )
            count = losses.shape[0]
            advantage = (advantage * count - advantage.sum(0, keepdim=True)) / (count - 1)
        elif baseline is not None:
            advantage = advantage - (baseline.detach() if isinstance(baseline, Tensor) else baseline)
        log_prob = self.log_prob(losses.shape)
        return losses + (advantage * (log_prob - log_prob.detach())).to(losses.dtype)


def record_score(log_prob: Callable[[], Tensor], where: str) -> None:
    """Hand a log-probability to the innermost ScoreFunction, for sensors with grad="score".

    Args:
        log_prob: gives the log-probability (..., C, H, W); called only if a gradient is wanted.
        where: name of the sensor, for errors.

    Raises:
        GradientError: without a context, where the gradient would silently be zero.
    """
    if not torch.is_grad_enabled():
        return
    value = log_prob()
    if not value.requires_grad:
        return
    active = _ACTIVE.get()
    if not active:
        raise GradientError(
            f"{where}: grad='score' needs the value of the loss. Call the sensor inside `with ScoreFunction() as "
            "score:` and differentiate score.surrogate(losses), or choose another grad policy."
        )
    active[-1]._log_probs.append(value)


# --------------------------------------------------------------------------------------------------------- base classes


Bins = tuple[float | None, int | None]  # width in seconds and number, None where any fits

# Two axes are the same when their bins agree to a millionth of a bin over the whole length.
SAME_BIN = 1e-6


class PhysicalModule(ScalarState):
    """Module whose numbers are physical and keep their precision when a model goes to half precision.

    In bfloat16 the logarithm of 60 ps is that of 62 ps, and 1e5 dark counts are infinite in float16. Devices, float32
    and float64 are followed; modules of another kind inside follow everything.

    Constructors of every subclass take arrays where they take tensors. An argument that requires a gradient is kept
    with it, or refused with GradientError.
    """

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        if "__init__" in cls.__dict__:
            cls.__init__ = careful_init(cls.__dict__["__init__"])  # type: ignore[method-assign]

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        def careful(value: Tensor) -> Tensor:
            moved = fn(value)
            return value.to(moved.device) if moved.dtype in (torch.float16, torch.bfloat16) else moved

        if recurse:
            for child in self.children():
                child._apply(fn)  # type: ignore[no-untyped-call]
        super()._apply(careful, recurse=False)  # type: ignore[no-untyped-call]
        return self

    def extra_repr(self) -> str:
        """Arguments that the module was made with, by their names; tensors of many numbers by their size."""
        made = [cls.__init__ for cls in type(self).__mro__ if "__init__" in cls.__dict__ and issubclass(cls, nn.Module)]
        names = [name for init in made for name in inspect.signature(init).parameters]
        given = {}
        for name in [*names, "bin_width_s", "num_bins"]:
            with contextlib.suppress(TorchTransientError):  # of a learnt value out of its range
                given[name] = _text(getattr(self, name, None))
        return ", ".join(f"{name}={text}" for name, text in given.items() if text)


_FEW = 8  # numbers of a list that a repr shows


def _text(value: object) -> str:
    """A number, a choice or a record; nothing for None and for what torch shows itself."""
    if isinstance(value, Tensor):
        if value.ndim > 1 or value.numel() > _FEW or value.is_meta:
            return f"(size {'x'.join(map(str, value.shape))})"
        value = value.detach().tolist()
    if isinstance(value, (list, tuple)):
        items = [_text(item) for item in value]
        return f"({', '.join(items)})" if items and all(items) and len(items) <= _FEW else ""
    if isinstance(value, float):
        return f"{value:g}"
    if is_dataclass(value):
        held = {field.name: _text(getattr(value, field.name)) for field in fields(value)}
        return f"{type(value).__name__}({', '.join(f'{name}={text}' for name, text in held.items() if text)})"
    return repr(value) if isinstance(value, (bool, int, str)) else ""


# What stages hand on: W / (m^2 sr) per bin, detections per laser cycle and bin, the mean charge (or photons) of a whole
# exposure, or what a detector has drawn.
Quantity = Literal["radiance", "rate", "electrons", "counts"]

# Where light enters a sensor, and the place of the light among the arguments.
_ENTRANCES = {
    **dict.fromkeys(("expected", "forward", "sample", "variance", "gaussian", "probabilities"), 0),
    "log_prob": 1,
}


def _entrance(method: Callable[..., Any], place: int) -> Callable[..., Any]:
    """Wrap a method of a sensor to check the bins of the light; see `Sensor`."""
    careful = in_single(method)

    @functools.wraps(method)
    def enter(self: Sensor, *args: Any, **keywords: Any) -> Any:
        self.check_bins(args[place] if len(args) > place else keywords.get("x"))
        return careful(self, *args, **keywords)

    return enter


class Sensor(PhysicalModule):
    """Base of sensors, from a transient (..., C, T, H, W) to a measurement. Deterministic: `forward` is `expected`.

    A subclass defines `expected`. `forward` takes `generator` in every sensor, so that chains call random and
    deterministic links alike. Half precision is taken and measured in float32, the least in which counts are counts.
    Light of another number of bins than `num_bins` is a ShapeError. Both hold for the methods of every subclass that
    light enters by: `expected`, `forward`, `sample`, `variance`, `gaussian`, `probabilities` and `log_prob`.

    Attributes:
        num_bins: T of the axis that the sensor was made with, None for one that takes any.
        takes: quantities that it can be given, empty for any. Chains compare them with what the stage before gives.
        gives: quantity of its output, "the same" as its input, None if unknown.
        window_is_period: True if its bins are one whole laser period.
    """

    num_bins: int | None = None
    takes: tuple[Quantity, ...] = ()
    gives: Quantity | Literal["the same"] | None = None
    window_is_period: bool = False

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        for name, place in _ENTRANCES.items():
            if name in cls.__dict__:
                setattr(cls, name, _entrance(cls.__dict__[name], place))

    def check_bins(self, x: object) -> None:
        """Check the number of bins of light.

        Args:
            x: light (..., C, T, H, W); anything else passes.

        Raises:
            ShapeError: if T is not that of the axis that the sensor was made with.
        """
        if self.num_bins is None or not isinstance(x, Tensor) or x.ndim < 4 or x.shape[TIME] == self.num_bins:
            return
        raise ShapeError(
            f"{type(self).__name__}: expected T = {self.num_bins} bins as in the axis (or period) it was made with, "
            f"got {x.shape[TIME]} of {tuple(x.shape)}. Make it with the axis of the light; bin_width_s= takes any T."
        )

    def expected(self, x: Tensor) -> Tensor:
        """Mean of the measurement, differentiable in the light and in the parameters.

        Args:
            x: light (..., C, T, H, W).
        """
        raise NotImplementedError(f"{type(self).__name__} has to define expected(x).")

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return ``expected(x)``.

        Args:
            x: light (..., C, T, H, W).
            generator: accepted so that chains can pass it, not used.
        """
        return self.expected(x)


class RandomSensor(Sensor):
    """Base of sensors that draw.

    A subclass defines `expected`, `sample`, and as far as it supports the policy: `variance` (or `gaussian`) for
    "gaussian", `log_prob` for "score". A policy without its method is a GradientError.

    Args:
        grad: gradient policy: what `forward` returns, and how gradients pass.
    """

    def __init__(self, grad: GradPolicy = "expected") -> None:
        super().__init__()
        self.grad: GradPolicy = check_policy(grad, type(self).__name__)

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Draw a measurement, without gradient.

        Args:
            x: light (..., C, T, H, W).
            generator: source of randomness.

        Returns:
            Shape and dtype of ``expected(x)``.
        """
        raise NotImplementedError(f"{type(self).__name__} has to define sample(x, generator).")

    def variance(self, x: Tensor) -> Tensor:
        """Variance of every entry of the measurement.

        Args:
            x: light (..., C, T, H, W).

        Returns:
            Shape of ``expected(x)``.

        Raises:
            GradientError: for sensors without one.
        """
        raise GradientError(f"{type(self).__name__}: grad='gaussian' is not supported; choose another policy.")

    def gaussian(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Draw a differentiable normal surrogate of `sample`, with independent entries by default.

        Args:
            x: light (..., C, T, H, W).
            generator: source of randomness.
        """
        return self.expected(x) + gaussian_noise(self.variance(x), generator)

    def log_prob(self, measurement: Tensor, x: Tensor) -> Tensor:
        """Log-probability of a measurement, summed over time, differentiable in the light.

        Args:
            measurement: result of `sample`.
            x: light (..., C, T, H, W).

        Returns:
            (..., C, H, W).

        Raises:
            GradientError: for sensors without one.
        """
        raise GradientError(f"{type(self).__name__}: grad='score' is not supported; choose another policy.")

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Measure light under the policy `grad`; equal generators in equal states give equal measurements.

        Args:
            x: light (..., C, T, H, W).
            generator: source of randomness.
        """
        if self.grad == "expected":
            return self.expected(x)
        if self.grad == "gaussian":
            return self.gaussian(x, generator)
        with torch.no_grad():
            measurement = self.sample(x, generator)
        if self.grad == "straight_through":
            return straight_through(measurement, self.expected(x)) if torch.is_grad_enabled() else measurement
        record_score(lambda: self.log_prob(measurement, x), type(self).__name__)
        return measurement


def bins_of(sensor: Sensor) -> Bins:
    """Return the bins that a sensor, or the first stage of a chain with bins, was made for.

    Args:
        sensor: sensor or chain.

    Returns:
        Width in seconds and number, None where any fits.
    """
    for part in sensor.modules():
        if not isinstance(part, Sensor):
            continue
        axis, width = getattr(part, "axis", None), getattr(part, "bin_width_s", None)
        if isinstance(axis, TimeAxis):
            return axis.bin_width_s, axis.num_bins
        if isinstance(width, float) or part.num_bins is not None:
            return (width if isinstance(width, float) else None), part.num_bins
    return None, None


def common_bins(sensors: Iterable[Sensor], where: str, own: Bins = (None, None)) -> Bins:
    """Return the bins of several sensors.

    Args:
        sensors: the sensors.
        where: name of the caller, for errors.
        own: bins of the caller.

    Returns:
        Width in seconds and number, None where any fits.

    Raises:
        UnitError: for sensors that were made for different ones.
    """
    width, number = own
    owner = where
    for sensor in sensors:
        name, (its_width, its_number) = type(sensor).__name__, bins_of(sensor)
        most = max(number or 1, its_number or 1)
        other_width = width and its_width and abs(width - its_width) * most > SAME_BIN * width
        if other_width or (number and its_number and number != its_number):
            raise UnitError(
                f"{where}: expected one time axis for all parts, got {bins_text(width, number)} in {owner} and "
                f"{bins_text(its_width, its_number)} in {name}. Make them with the axis of the light."
            )
        if (width is None and its_width) or (number is None and its_number):
            owner = name
        width, number = width or its_width, number or its_number
    return width, number


def bins_text(width: float | None, number: int | None) -> str:
    """Describe bins for a message.

    Args:
        width: bin width in seconds, None where any fits.
        number: number of bins, None where any fits.
    """
    many = "bins" if number is None else f"{number} bins"
    return many if width is None else f"{many} of {width:g} s"


# -------------------------------------------------------------------------------------------- sensors around a detector


def added(parts: Iterable[Tensor]) -> Tensor:
    """Sum tensors in their order.

    Args:
        parts: tensors of one shape.
    """
    return functools.reduce(torch.add, parts)


class WrappedDetector(RandomSensor):
    """Base of random sensors around a detector, which makes the draws.

    ``grad`` is the detector's, and sets it.

    Args:
        detector: the detector.
        grad: gradient policy, None to leave the detector's.
    """

    detector: RandomSensor
    # cycles by which counts of the whole exposure and pixel are divided; None: those of the detector
    exposure_cycles: float | None = None

    def __init__(self, detector: RandomSensor, grad: GradPolicy | None = None) -> None:
        super(RandomSensor, self).__init__()
        self.detector = detector
        self.bin_width_s, self.num_bins = bins_of(detector)
        if grad is not None:
            self.grad = grad

    @property
    def grad(self) -> GradPolicy:
        """The policy of the detector."""
        return self.detector.grad

    @grad.setter
    def grad(self, value: GradPolicy) -> None:
        self.detector.grad = check_policy(value, type(self).__name__)

    def check_bins(self, x: object) -> None:
        super().check_bins(x)
        self.detector.check_bins(x)


def several_of(detector: RandomSensor, number: int, share: float = 1.0) -> RandomSensor:
    """Make a detector whose counts are the sum of several equal detectors, each in the same light.

    It has the cycles of all of them, and the same parameters.

    Args:
        detector: one of the detectors.
        number: number of detectors.
        share: share that each detector has of the light, and of the counts, that are given for a whole pixel.

    Returns:
        A shallow copy of the detector.
    """
    other = copy.copy(detector)
    if isinstance(other, WrappedDetector):
        other.exposure_cycles = (other.exposure_cycles or cycles_of(detector)) / share
        other._modules = dict(other._modules)  # its own children
        other.detector = several_of(other.detector, number)
    else:
        other.cycles = cycles_of(detector) * number  # type: ignore[assignment]
        if hasattr(other, "trains"):  # detections of different detectors know nothing of one another
            other.trains = other.trains * number  # type: ignore[assignment, operator]
    return other


def cycles_of(detector: RandomSensor) -> int:
    """Return the number of laser cycles that a detector counts.

    Args:
        detector: a detector, or a sensor around one.
    """
    inner = detector
    while isinstance(inner, WrappedDetector):
        inner = inner.detector
    return int(inner.cycles)  # type: ignore[arg-type]


# ------------------------------------------------------------------------------------------------------- linear part


@in_single
def adjoint(sensor: Sensor, y: Tensor, input_shape: Sequence[int]) -> Tensor:
    """Apply the transpose of a sensor's mean, exactly: ``A^T y``.

    ``A`` is the linear part of `expected`, ``x -> expected(x) - expected(0)``; a sensor that is not linear gives the
    transpose of its derivative at zero: see `linearity_error`. Differentiable in ``y`` and in the sensor's parameters,
    so that an unrolled reconstruction can be trained through it.

    Args:
        sensor: the sensor.
        y: measurement, in the shape of the sensor's output.
        input_shape: shape of the light.

    Returns:
        Tensor of ``input_shape``, in dtype and device of ``y``.
    """
    learnt = any(p.requires_grad for p in sensor.parameters())
    onwards = torch.is_grad_enabled() and (y.requires_grad or learnt)
    with torch.inference_mode(False), torch.enable_grad():
        y = y.clone() if y.is_inference() else y
        x = torch.zeros(tuple(input_shape), dtype=y.dtype, device=y.device, requires_grad=True)
        (gradient,) = torch.autograd.grad(sensor.expected(x), x, y, create_graph=onwards)
    return gradient


def linearity_error(sensor: Sensor, x: Tensor) -> float:
    """Measure how far a sensor's mean is from linear: ``|A(2 x) - 2 A(x)| / |A(2 x)|`` without its offset.

    Args:
        sensor: the sensor.
        x: light (..., C, T, H, W).

    Returns:
        Rounding for a linear sensor.
    """
    with torch.no_grad():
        offset = sensor.expected(torch.zeros_like(x))
        once, twice = sensor.expected(x) - offset, sensor.expected(2 * x) - offset
        return float((twice - 2 * once).abs().max() / twice.abs().max().clamp_min(torch.finfo(x.dtype).tiny))

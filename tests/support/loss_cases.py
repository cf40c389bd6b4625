"""The table of losses: one entry brings the contract tests of `tests/losses`."""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch

from torchtransient import FrequencyAxis, TimeAxis, losses

BINS = 8
AXIS = TimeAxis(1.0, 0.05, BINS)
BAND = FrequencyAxis.uniform(1.0, 0.7, 5)
TRANSIENT, VOLUME, PICTURE = (2, 1, BINS, 4, 5), (2, 1, 6, 5, 7), (2, 2, 9, 8)
PIXELS, ALL = (..., slice(1, 3), slice(1, 4)), (..., slice(2, 6), slice(1, 4), slice(1, 4))
CYCLES = 400
# What a scan point sees of the planes behind it: a light-weight linear operator that mixes no points.
_PLANES_TO_BINS = torch.rand(BINS, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(5))


def operator(volume):
    return torch.einsum("tz,...zyx->...tyx", _PLANES_TO_BINS.to(volume), volume)


def positive(shape, generator, dtype=torch.float64):
    return 0.1 + torch.rand(shape, generator=generator, dtype=torch.float64).to(dtype)


def complex_numbers(shape, generator, dtype=torch.float64):
    return torch.complex(*(torch.randn(shape, generator=generator, dtype=torch.float64).to(dtype) for _ in range(2)))


def counts(shape, generator, dtype=torch.float64):
    return torch.randint(0, 6, shape, generator=generator).to(dtype)


def halved(x):
    return x.float() / 2 if x.is_floating_point() and x.element_size() < 4 else x / 2


@dataclass(frozen=True)
class LossCase:
    """A loss: its function, its module, their options, and the properties that the contract tests hold it to."""

    name: str
    function: Callable[..., torch.Tensor]
    module: Callable[..., torch.nn.Module]
    options: dict[str, Any] = field(default_factory=dict)
    input_shape: tuple[int, ...] = TRANSIENT
    target_shape: tuple[int, ...] | None = None
    draw: Callable[..., torch.Tensor] = positive
    draw_target: Callable[..., torch.Tensor] | None = None
    crop: tuple[Any, ...] | None = ALL  # what a mask may leave over as if nothing else had been there; None: nothing
    symmetric: bool = True
    zero_at_equality: bool = True
    pair: bool = True
    mapped: bool = True  # torch.vmap
    floors_detached: bool = False  # the scale of an item goes in without gradient
    dim: int | None = None  # where time is, of losses that want to know it
    second: Callable[..., torch.Tensor] | None = None  # what a loss of (input, another, target) is given as another

    def tensors(self, seed=0, dtype=torch.float64):
        generator = torch.Generator().manual_seed(seed)
        x = self.draw(self.input_shape, generator, dtype)
        return x, (self.draw_target or self.draw)(self.target_shape or self.input_shape, generator, dtype)

    def arguments(self, input, target):
        if not self.pair:
            return (input,)
        if self.second is not None:
            return input, self.second(input), target
        return input, target

    def __call__(self, input, target, mask=None, reduction="mean", **more):
        return self.function(*self.arguments(input, target), **self.options, **more, mask=mask, reduction=reduction)

    @property
    def said(self):
        """The dimension of time, for tensors that do not show it by their number of dimensions."""
        return {} if self.dim is None else {"dim": self.dim}

    def as_module(self, input, target, mask=None, reduction="mean"):
        module = self.module(**self.options, reduction=reduction)
        return module(*self.arguments(input, target), mask=mask)

    def __str__(self):
        return self.name


def _measurement(name, **options):
    return LossCase(
        name, losses.measurement_consistency, losses.MeasurementConsistency, {"operator": operator, **options},
        input_shape=VOLUME, target_shape=(2, 1, BINS, 5, 7), crop=PIXELS, symmetric=False, zero_at_equality=False,
        dim=-3,
    )  # fmt: skip


def _phasors(name, **options):
    return LossCase(
        name, losses.transient_phasor_loss, losses.TransientPhasorLoss, {"axis": AXIS, "frequencies": BAND, **options},
        crop=PIXELS, floors_detached=options == {"phase_only": True}, dim=-3,
    )  # fmt: skip


def _likelihood(name, function, module, *, dim=-3, **options):
    return LossCase(
        name, function, module, options, draw_target=counts, crop=PIXELS, symmetric=False,
        zero_at_equality=False, mapped=False, dim=dim,
    )  # fmt: skip


def _mesh(points):
    """A triangle of any three numbers, and one at its side."""
    corners = torch.stack([points[..., :3].flatten()[:9].reshape(3, 3), torch.eye(3).to(points)])
    faces = torch.tensor([[0, 1, 2]], device=points.device)
    return losses.surface_distance(corners[0], faces, corners[1], faces)


WIDTH = {"bin_width_opl": 0.05}
VOLUMES = {"input_shape": VOLUME}
CASES = [
    LossCase("squared", losses.squared_loss, losses.SquaredLoss),
    LossCase("squared, complex", losses.squared_loss, losses.SquaredLoss, draw=complex_numbers),
    _measurement("measurement"),
    _measurement("measurement, scale invariant", scale_invariant=True),
    _measurement("measurement, roots", compare=losses.root_loss),
    LossCase("phasor", losses.phasor_loss, losses.PhasorLoss, draw=complex_numbers),
    LossCase("phasor, phase only", losses.phasor_loss, losses.PhasorLoss, {"phase_only": True, "floor": 0.1},
             draw=complex_numbers, dim=-3),
    _phasors("transient phasor"),
    _phasors("transient phasor, phase only", phase_only=True, floor=0.1),
    _phasors("transient phasor, phase only, own floor", phase_only=True),
    # eight bins of 0.6 on average: some pixels are darker than the floor
    LossCase("Wasserstein", losses.wasserstein_loss, losses.WassersteinLoss, {**WIDTH, "floor": 4.0}, dim=-3),
    LossCase("Wasserstein, own floor", losses.wasserstein_loss, losses.WassersteinLoss, WIDTH, floors_detached=True,
             dim=-3),
    LossCase("Wasserstein, unbalanced", losses.wasserstein_loss, losses.WassersteinLoss,
             {**WIDTH, "creation_cost_opl": 0.3}, dim=-3),
    LossCase("running sums", losses.cumulative_loss, losses.CumulativeLoss, WIDTH, dim=-3),
    LossCase("running sums, by their noise", losses.cumulative_loss, losses.CumulativeLoss,
             {**WIDTH, "per_root_count": True}, symmetric=False, floors_detached=True, dim=-3),
    LossCase("many scales", losses.multiscale_loss, losses.MultiscaleLoss, crop=PIXELS, dim=-3),
    LossCase("many scales, first photon", losses.multiscale_loss, losses.MultiscaleLoss,
             {"compare": functools.partial(losses.first_photon_nll, cycles=CYCLES)},
             draw_target=counts, crop=None, symmetric=False, zero_at_equality=False, mapped=False, dim=-3),
    LossCase("Anscombe", losses.root_loss, losses.RootLoss),
    LossCase("expected root", losses.expected_root_loss, losses.ExpectedRootLoss, symmetric=False,
             zero_at_equality=False),
    LossCase("two renders", losses.two_render_loss, losses.TwoRenderLoss, symmetric=False, zero_at_equality=False,
             second=halved),
    LossCase("two renders, complex", losses.two_render_loss, losses.TwoRenderLoss, draw=complex_numbers,
             symmetric=False, zero_at_equality=False, second=halved),
    LossCase("log ratio", losses.log_ratio_loss, losses.LogRatioLoss, {"background": 0.05}, dim=-3),
    LossCase("log ratio, own background", losses.log_ratio_loss, losses.LogRatioLoss, symmetric=False,
             floors_detached=True, dim=-3),
    LossCase("total variation", losses.total_variation, losses.TotalVariation, {"smoothing": 0.01}, pair=False,
             zero_at_equality=False, **VOLUMES),
    LossCase("total variation, along the axes", losses.total_variation, losses.TotalVariation,
             {"isotropic": False, "spacing": (0.1, 0.2, 0.2)}, pair=False, zero_at_equality=False, floors_detached=True,
             **VOLUMES),
    LossCase("total variation, complex, not smoothed", losses.total_variation, losses.TotalVariation,
             {"smoothing": 0.0}, pair=False, zero_at_equality=False, draw=complex_numbers, **VOLUMES),
    LossCase("depth", losses.depth_loss, losses.DepthLoss, input_shape=PICTURE, crop=PIXELS),
    LossCase("depth, any scale", losses.scale_invariant_depth_loss, losses.ScaleInvariantDepthLoss,
             input_shape=PICTURE, crop=PIXELS),
    LossCase("SSIM", losses.ssim_loss, losses.SSIMLoss, {"window": 5, "value_range": 1.1}, input_shape=PICTURE,
             crop=None),
    LossCase("SSIM, own range", losses.ssim_loss, losses.SSIMLoss, {"window": 3}, input_shape=PICTURE, crop=None,
             symmetric=False, floors_detached=True),
    LossCase("SSIM of projections", losses.projection_ssim_loss, losses.ProjectionSSIMLoss,
             {"window": 3, "value_range": 1.1}, crop=None, **VOLUMES),
    _likelihood("Poisson", losses.poisson_nll, losses.PoissonNLL, dim=None),
    _likelihood("Poisson, floor", losses.poisson_nll, losses.PoissonNLL, dim=None, floor=1e-3),
    _likelihood("first photon", losses.first_photon_nll, losses.FirstPhotonNLL, cycles=CYCLES),
    _likelihood("first photon, dead time and floor", losses.first_photon_nll, losses.FirstPhotonNLL, cycles=CYCLES,
                dead_bins=2.0, floor=1e-3),
    _likelihood("free running", losses.free_running_nll, losses.FreeRunningNLL, periods=CYCLES, dead_bins=2.5),
    LossCase("read noise", losses.read_noise_nll, losses.ReadNoiseNLL, {"read_noise": 0.7}, draw_target=counts,
             symmetric=False, zero_at_equality=False),
]
# What is public and no loss of (input, target): parts of losses and losses of other things, of one tensor each.
OTHERS = {
    losses.surface_distance: _mesh,
    losses.relative_floor: losses.relative_floor,
    losses.anscombe: losses.anscombe,
    losses.armed_periods: lambda x: losses.armed_periods(x, 20, 2.5),
    losses.expected_anscombe: losses.expected_anscombe,
    losses.transient_phasors: lambda x: losses.transient_phasors(x, AXIS, BAND),
    losses.maximum_projections: lambda x: torch.cat([view.flatten() for view in losses.maximum_projections(x)]),
}  # fmt: skip
# Losses of one mesh (vertices, faces), with tests of their own.
MESHES = {
    losses.mesh_laplacian_smoothing: losses.MeshLaplacianSmoothing,
    losses.mesh_normal_consistency: losses.MeshNormalConsistency,
}


# Options that are numbers: those of the signatures, which are tested with the values below, or with those of a case.
# One value that fits, or that of one case.
FITS = {
    **dict.fromkeys(("floor", "background", "smoothing", "read_noise", "creation_cost_opl", "share"), 0.7),
    **dict.fromkeys(("bin_width_opl", "balance"), 0.05),
    **dict.fromkeys(("cycles", "periods"), 400.0),
    **dict.fromkeys(("window", "value_range"), 3.0),
    "dead_bins": 2.5,
    "spacing": (0.1, 0.2, 0.3),
    ("Wasserstein", "floor"): 4.0,
}
# Values of which a loss makes a plausible number; of other options a negative one and NaN.
WRONG = {
    **dict.fromkeys(("floor", "background", "smoothing", "read_noise"), (-1.0, float("nan"), torch.rand(13))),
    **dict.fromkeys(("bin_width_opl", "creation_cost_opl"), (1e-10, -1.0)),  # seconds
    **dict.fromkeys(("cycles", "periods"), (0, 2.5)),
    "value_range": (-1.0, 0.0),
    "balance": (-0.1, 1.1),
    "window": (0, 4),
    "spacing": ((1.0, 1.0), (1.0, 0.0, 1.0)),
}
# Options without a part beside the others of a case: phases have a floor, and so do records of mass one.
IDLE = {("phasor", "floor"), ("transient phasor", "floor"), ("Wasserstein, unbalanced", "floor")}


def number_options(made):
    """Names of the options of a loss, function or module, that are numbers; places of dimensions are none."""
    options = inspect.signature(made).parameters.items()
    numbers = [name for name, option in options if re.search(r"\b(float|int|Numbers)\b", str(option.annotation))]
    return [name for name in numbers if name != "dim"]

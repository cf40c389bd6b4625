"""A rendered scene near its truth, with noise as its renders have it: where fits end, without a step of an optimiser.

Near the truth expected counts are `mean + J shift + noise`: mean and J of very many samples, noise of renders at the
truth. The layer draws the samples of a derivative anew, so that a fit ends, on average, where `J^T E f'(render) = 0`:
the least point, in the shift, of the mean loss over many draws of the noise. With a derivative of the same samples each
draw has its own J. Needs `_runner` to be imported first.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from _runner import ROOT
from torch import Tensor

import torchtransient as tt

sys.path.insert(0, str(ROOT / "training_examples"))
import two_walls

Loss = Callable[[Tensor, Tensor], Tensor]
GROUPS = 8


@dataclass(frozen=True)
class Scene:
    """The two walls with their counter: expected counts of any unknowns, of any number of samples and seeds."""

    renderer: tt.TransientRenderer
    sensor: torch.nn.Module

    @classmethod
    def build(cls) -> Scene:
        return cls(two_walls.renderer(), two_walls.known_counter())

    def counts(self, unknowns: Tensor, spp: int, seeds: Sequence[int]) -> Tensor:
        """(B, 1, T, H, W) of unknowns (B, 6), or (6,) with a seed each."""
        each = unknowns.expand(len(seeds), 6)
        light = self.renderer(two_walls.values_of(each), spp=spp, seed=list(seeds)).transient
        return self.sensor.expected(light)

    @torch.no_grad()
    def draws(self, unknowns: Tensor, spp: int, seeds: Sequence[int]) -> Tensor:
        """The same in double precision, 32 at a time."""
        parts = [seeds[k : k + 32] for k in range(0, len(seeds), 32)]
        return torch.cat([self.counts(unknowns, spp, part).double() for part in parts])

    def slopes(self, unknowns: Tensor, spp: int, seeds: Sequence[int], *, same: bool = False) -> Tensor:
        """(B, 6, T, H, W): derivatives of expected counts by the unknowns, forward mode; `same`: of the samples that
        `draws` has with these seeds.
        """
        before, self.renderer.grad_seed = self.renderer.grad_seed, "same" if same else None
        found = []
        for k in range(0, len(seeds), 32):
            part = seeds[k : k + 32]
            each = [
                torch.func.jvp(lambda u, part=part: self.counts(u, spp, part), (unknowns,), (along,))[1]
                for along in torch.eye(6)
            ]
            found.append(torch.cat(each, 1).double())
        self.renderer.grad_seed = before
        return torch.cat(found)


@dataclass(frozen=True)
class Linear:
    """`mean` (1, T, H, W) and its `slopes` (6, T, H, W) at one truth (6,); all in double precision."""

    truth: Tensor
    mean: Tensor
    slopes: Tensor

    @classmethod
    def at(cls, scene: Scene, truth: Tensor, spp: int, seeds: Sequence[int]) -> Linear:
        mean = scene.draws(truth, spp, seeds).mean(0)
        return cls(truth.double(), mean, scene.slopes(truth, spp, seeds[: max(1, len(seeds) // 4)]).mean(0))

    def covariance(self, free: Sequence[int]) -> Tensor:
        """Of the unknowns that are not known, by the Fisher information of one capture of counts."""
        columns = self.slopes[list(free)].flatten(1)
        return (columns / self.mean.flatten() @ columns.T).inverse()

    def spread(self) -> Tensor:
        """(6,) standard deviations of the best fit to one capture, renders being exact."""
        return self.covariance(range(6)).diagonal().sqrt()

    def least(
        self, loss: Loss, noise: Tensor, target: Tensor, *, free: Sequence[int] = range(6), slopes: Tensor | None = None
    ) -> Tensor:
        """(6,) shift from the truth at which the mean of `loss(expected counts, target)` over draws is least.

        `noise`: (K, R, T, H, W) of R renders a draw; `target`: (1 or K, 1, T, H, W). `slopes`: (K, 6, T, H, W) of each
        draw. NaN where the search does not end.
        """
        root = torch.linalg.cholesky(self.covariance(free))
        columns = (self.slopes if slopes is None else slopes)[..., list(free), :, :, :]
        number = max(len(noise), len(target))
        target = target.expand(number, -1, -1, -1, -1)

        def value_and_slope(place: Tensor) -> tuple[Tensor, Tensor]:
            place = place.detach().requires_grad_()
            moved = torch.einsum("...ithw,i->...thw", columns, root @ place)
            model = self.mean + noise + (moved if slopes is None else moved[:, None])
            value = loss(model.expand(number, -1, -1, -1, -1), target) / number
            (slope,) = torch.autograd.grad(value, place)
            return value.detach(), slope

        found = _descent(value_and_slope, len(free))
        shift = torch.zeros(6, dtype=torch.float64)
        shift[list(free)] = root @ found
        return shift

    def in_groups(
        self, loss: Loss, noise: Tensor, target: Tensor, *, free: Sequence[int] = range(6), slopes: Tensor | None = None
    ) -> Tensor:
        """(GROUPS, 6) of as many independent parts of the draws: their mean is the estimate, their spread its error."""
        parts = noise.chunk(GROUPS)
        targets = target.chunk(GROUPS) if len(target) > 1 else [target] * GROUPS
        own = [None] * GROUPS if slopes is None else slopes.chunk(GROUPS)
        found = [self.least(loss, n, t, free=free, slopes=s) for n, t, s in zip(parts, targets, own, strict=True)]
        return torch.stack(found)


def _descent(value_and_slope: Callable[[Tensor], tuple[Tensor, Tensor]], size: int) -> Tensor:
    """BFGS from a Hessian of differences of slopes, steps halved until the value falls; NaN if it does not end.

    Differences over a fifth of a standard deviation, since losses with kinks have a curvature over many elements only.
    """
    place, apart, one = torch.zeros(size, dtype=torch.float64), 0.2, torch.eye(size, dtype=torch.float64)
    value, slope = value_and_slope(place)
    hessian = torch.stack([(value_and_slope(apart * along)[1] - slope) / apart for along in one])
    scales, axes = torch.linalg.eigh((hessian + hessian.T) / 2)
    inverse = axes / scales.abs().clamp_min(1e-3 * scales.abs().max()) @ axes.T
    last = torch.inf
    for _ in range(60):
        step = -inverse @ slope
        step = step * min(1.0, 10 / float(step.norm().clamp_min(1e-300)))
        for _ in range(12):
            there, its_slope = value_and_slope(place + step)
            if there <= value + 1e-4 * float(step @ slope):
                break
            step = step / 2
        else:
            return place  # no lower point along the way down: rounding, or a kink
        change, turned = its_slope - slope, float(step @ (its_slope - slope))
        if turned > 0:
            left = one - torch.outer(step, change) / turned
            inverse = left @ inverse @ left.T + torch.outer(step, step) / turned
        place, value, slope, last = place + step, there, its_slope, float(step.norm())
        if last < 1e-3:
            return place
    return place if last < 0.02 else torch.full_like(place, torch.nan)

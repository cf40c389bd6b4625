"""Walls, counts and the network that the examples of training in processes and with Lightning share.

A camera with a point light beside it looks at a wall 3.7 to 4.3 m away, tilted by up to 20 degrees: 6 x 6 pixels, 66
bins of 3 cm of path, about 4 photons of the laser and 13 of ambient light in each pixel. Distance and tilt are unknown.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

import torchtransient as tt
from torchtransient import sensing
from torchtransient.parametrize import pose_from_axis_angle

KEY = "wall.to_world"
CAMERA_HEIGHT, FURTHEST_M, STEEPEST_DEG = 4.0, 0.3, 20.0
FIELD_DEG, LIGHT_X = 10.0, 0.5  # of tt.scenes.moving_wall
AXIS = tt.TimeAxis(7.0, 0.03, 66)
PIXELS, SIGNAL, AMBIENT = 6, 4.0, 13.0  # pixels per side; photons of a pixel, in the mean
FWHM_OPL = 0.1  # of the response of the detector
RESPONSE = tt.Pulse.gaussian(FWHM_OPL)
FAR_SHARE = 0.25
PLANE, NETWORK, UNTRAINED = "plane fit", "trained by the renderer", "untrained"

Planes = tuple[Tensor, Tensor]  # distances (B,) in metres and tilts (B,) in degrees


@dataclass(frozen=True)
class Sizes:
    """``train``, ``test``: walls. ``batch``: walls of a step. ``spp``: of the renders in it."""

    train: int = 512
    test: int = 128
    steps: int = 400
    batch: int = 16
    spp: int = 16
    test_spp: int = 256


SMOKE = Sizes(train=32, test=16, steps=20, batch=4, spp=4)


def scene() -> dict[str, object]:
    return tt.scenes.moving_wall(resolution=PIXELS, max_depth=2)


def recipe(spp: int) -> tt.data.Recipe:
    """Random walls, as light: counts are drawn from it anew at every step."""
    data = tt.data
    shifted = data.Offset([0.0, 0.0, -FURTHEST_M], [0.0, 0.0, FURTHEST_M])
    pose = data.Compose([data.Turn([0, 1, 0], -STEEPEST_DEG, STEEPEST_DEG), shifted])
    return data.Recipe(scene(), {KEY: pose}, time_axis=AXIS, spp=spp, variant="llvm_ad_mono", irf=RESPONSE)


def folder_of(output: Path, sizes: Sizes, generate: bool = True) -> Path:
    """Where a data set of those walls is; generated, where some of it is not there."""
    made, count = recipe(sizes.test_spp), sizes.test + sizes.train
    folder = output / f"walls-{made.key()[:8]}-{count}"
    if generate:
        tt.data.generate(made, folder, count, workers=1)
    return folder


def wall_to_world(distance: Tensor, tilt_deg: Tensor) -> Tensor:
    """(B,) metres and degrees -> (B, 4, 4): a wall so far before the camera, turned about the y axis."""
    zero = torch.zeros_like(distance)
    return pose_from_axis_angle(
        torch.stack([zero, torch.deg2rad(tilt_deg), zero, zero, zero, CAMERA_HEIGHT - distance], dim=1)
    )


def truth_of(to_world: Tensor) -> Planes:
    """The inverse: distances and tilts of walls."""
    tilt = torch.rad2deg(torch.atan2(to_world[:, 0, 2], to_world[:, 0, 0]))
    return CAMERA_HEIGHT - to_world[:, 2, 3], tilt


def expected_counts(transient: Tensor) -> Tensor:
    """Photons a bin, ambient light included, of transients (..., 1, T, H, W) of any brightness."""
    share = transient / transient.sum((-3, -2, -1), keepdim=True)
    return SIGNAL * PIXELS**2 * share + AMBIENT / AXIS.num_bins


def measured(batch: dict[str, Tensor], seeds: tt.training.Seeds, step: int) -> Tensor:
    """Counts of a batch: each wall has noise of its own, whichever process has it."""
    mean, noise = expected_counts(batch["transient"]), sensing.ShotNoise()
    drawn = [noise.sample(m, seeds.generator(step, int(n))) for m, n in zip(mean, batch["index"], strict=True)]
    return torch.stack(drawn)


def matched(counts: Tensor) -> Tensor:
    """Log-likelihood (B, 1, T, H, W) of a return at every bin."""
    first, kernel = sensing.GaussianResponse(fwhm_s=tt.units.opl_to_seconds(FWHM_OPL)).kernel(AXIS.bin_width_s)
    return sensing.log_matched_filter(counts, kernel.to(counts), first, signal_to_background=SIGNAL * 5)


class Proposer(nn.Module):
    """Distances (B,) in metres and tilts (B,) in degrees of counts (B, 1, T, H, W).

    Pixels are channels of convolutions over time, so that a wall that is farther away looks the same, only later. They
    add to the scores of the matched filter; what is left of a pixel is the mean time of its softmax.
    """

    def __init__(self, channels: int = 64) -> None:
        super().__init__()
        pixels, half = PIXELS**2, 4
        self.layers = nn.Sequential(
            nn.Conv1d(pixels, channels, 2 * half + 1, padding=half), nn.SiLU(),
            nn.Conv1d(channels, channels, 2 * half + 1, padding=half), nn.SiLU(),
            nn.Conv1d(channels, pixels, 1, bias=False),  # a softmax does not see what is added to all of its entries
        )  # fmt: skip
        self.plane = nn.Sequential(nn.Linear(pixels, 64), nn.SiLU(), nn.Linear(64, 2), nn.Tanh())
        self.register_buffer("time", torch.linspace(-1, 1, AXIS.num_bins))

    def forward(self, counts: Tensor) -> Planes:
        scores = matched(counts)[:, 0].flatten(2).transpose(1, 2)
        arrival = (torch.softmax(scores + self.layers(scores), dim=2) * self.time).sum(2)
        found = self.plane(arrival)
        return CAMERA_HEIGHT + 1.2 * FURTHEST_M * found[:, 0], 1.2 * STEEPEST_DEG * found[:, 1]


class Reader(nn.Module):
    """The counts (B, 1, T, H, W) that walls would give which a network proposes from counts."""

    def __init__(self, spp: int) -> None:
        super().__init__()
        self.propose = Proposer()
        described = tt.load(scene(), variant="llvm_ad_mono")
        self.renderer = tt.TransientRenderer(described, [KEY], spp=spp, time_axis=AXIS, irf=RESPONSE)
        # The pose that the scene is described with is replaced at each call, and learns nothing.
        self.renderer.requires_grad_(False)

    def forward(self, counts: Tensor, seeds: list[int]) -> Tensor:
        out = self.renderer({KEY: wall_to_world(*self.propose(counts))}, seed=seeds)
        return expected_counts(out.transient)


def plane_fit(counts: Tensor) -> Planes:
    """Distances and tilts of the plane through the peaks of a matched filter, by least squares: no network."""
    opl = AXIS.start_opl + AXIS.bin_width_opl * sensing.peak_position(matched(counts)).reshape(len(counts), -1)
    tangent = (2 * torch.arange(PIXELS) + 1 - PIXELS) / PIXELS * torch.tan(torch.deg2rad(torch.tensor(FIELD_DEG / 2)))
    across, along = tangent.repeat(PIXELS), tangent.repeat_interleave(PIXELS)
    forward = 1 / (1 + across.square() + along.square()).sqrt()
    # A point at range r in the direction u has the length r + |r u - b|, with the light at b beside the camera.
    length = (opl.square() - LIGHT_X**2) / (2 * (opl - LIGHT_X * across * forward))
    depth = length * forward
    rows = torch.stack([torch.ones_like(depth), depth * across], dim=2)
    found = torch.linalg.lstsq(rows, depth.unsqueeze(2)).solution[:, :, 0]
    return found[:, 0], torch.rad2deg(torch.atan(found[:, 1]))


def loss_of(share: float, model: Tensor, counts: Tensor) -> Tensor:
    """What is minimised when a ``share`` of the steps is done: first a distance, which has a slope from anywhere, then
    the likelihood, which says how much each photon counts.
    """
    if share < FAR_SHARE:
        return tt.losses.wasserstein_loss(model, counts, AXIS.bin_width_opl)
    return tt.losses.poisson_nll(model, counts)


def errors_of(found: Planes, truth: Planes) -> tuple[float, float]:
    """Mean absolute errors: of the distance in millimetres, of the tilt in degrees."""
    distance, tilt = ((a - b).abs().mean().item() for a, b in zip(found, truth, strict=True))
    return 1e3 * distance, tilt


def report(label: str, found: dict[str, Planes], truth: Planes) -> None:
    """Prints the errors by method."""
    for name, planes in found.items():
        millimetres, degrees = errors_of(planes, truth)
        print(f"{label}, {name:<24}{millimetres:8.1f} mm{degrees:8.2f} degrees")


def draw(found: dict[str, Planes], truth: Planes, losses: list[float], path: Path) -> None:
    """Distance and tilt found over true, and the loss."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.3), layout="constrained")
    axes = figure.subplots(1, 3)
    shown = {PLANE: "0.6", NETWORK: "tab:blue"}
    for n, (name, unit, low, high) in enumerate((("distance", "m", 3.65, 4.35), ("tilt", "degrees", -23, 23))):
        for method, colour in shown.items():
            axes[n].plot(truth[n], found[method][n], ".", color=colour, ms=4, label=method)
        axes[n].plot([low, high], [low, high], color="black", lw=0.8)
        axes[n].set(xlim=(low, high), ylim=(low, high), xlabel=f"true {name} [{unit}]", ylabel=f"found [{unit}]")
    axes[0].legend(fontsize=8)
    change = int(FAR_SHARE * len(losses))
    axes[2].plot(losses[:change], color="tab:green", lw=0.8)
    axes[2].set(xlabel="step", title="no labels in the loss")
    axes[2].set_ylabel("Wasserstein-1 to the counts [m]", color="tab:green")
    other = axes[2].twinx()
    other.plot(range(change, len(losses)), losses[change:], color="tab:blue", lw=0.8)
    other.set_ylabel("negative log-likelihood of a bin", color="tab:blue")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)

"""Calibrate the response of a detector: fit a model of pulse and tails to measured histograms by gradient descent.

Two fits, each where its data are given:

--irf FILE       one measured impulse response, .npy (T,), in bins of --bin-width-ps. The model is a sum of lobes (the
                 pulse, reflections inside the detector, a second pulse), each normal with a diffusion tail.
--frames FILES   histograms of a consumer chip, .npz with hists (zones, T), in bins of --frame-bin-ps. All zones share
                 width and tail, each has its own arrival, brightness and background.

    python training_examples/calibrate_irf.py --irf measured.npy --bin-width-ps 8 --output demo_output

Prints the parameters and what is left over, and draws both.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from torchtransient import sensing
from torchtransient.sensing import Response

BEFORE = 100  # bins that a response is turned by when it begins in its highest bin


class Lobes(Response):
    """A weighted sum of normal lobes with a diffusion tail each."""

    def __init__(self, delays_s: Sequence[float], shares: Sequence[float], fwhm_s: float, tail_s: float) -> None:
        super().__init__(0.0, learnable=False)
        self.lobes = nn.ModuleList(
            sensing.TailedResponse(fwhm_s, [tail_s], [0.3], delay_s=d, learnable=True) for d in delays_s
        )
        self.share_logits = nn.Parameter(torch.tensor(shares, dtype=torch.float64).log())

    @property
    def shares(self) -> Tensor:
        """(K,): what part of the light each lobe has."""
        return self.share_logits.softmax(0)

    def cdf(self, time_s: Tensor) -> Tensor:
        """Share of the response before each time."""
        return sum((w * lobe.cdf(time_s) for w, lobe in zip(self.shares, self.lobes, strict=True)), time_s * 0)

    def describe(self) -> list[str]:
        """A line for each lobe, in order of time."""
        lines = []
        with torch.no_grad():
            for share, lobe in sorted(zip(self.shares, self.lobes, strict=True), key=lambda x: float(x[1].delay_ps)):
                lines.append(
                    f"  lobe at {float(lobe.delay_ps):8.1f} ps: share {float(share):.3f}, "
                    f"width {float(lobe.fwhm_s) * 1e12:6.1f} ps, tail {float(lobe.tails_s[0]) * 1e12:6.1f} ps in "
                    f"{float(lobe.fractions[0]):.2f} of it"
                )
        return lines


def stabilized(x: Tensor, floor: float) -> Tensor:
    """Root of counts: its noise is the same everywhere, so that tails weigh as much as peaks."""
    return (x.clamp_min(0) + floor).sqrt()


def descend(parameters: list[Any], loss_of: Callable[[], Tensor], steps: int, rate: float, label: str) -> list[float]:
    """Adam with a cosine schedule; returns the losses."""
    optimizer = torch.optim.Adam(parameters, lr=rate, betas=(0.8, 0.98))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, rate / 100)
    losses = []
    for _ in (bar := tqdm(range(steps), desc=label, unit="step")):
        optimizer.zero_grad()
        loss = loss_of()
        loss.backward()
        optimizer.step()
        schedule.step()
        losses.append(float(loss.detach()))
        bar.set_postfix(loss=f"{losses[-1]:.2e}")
    return losses


def fit_response(counts: Tensor, bin_width_s: float, lobes: int, steps: int) -> tuple[Lobes, Tensor]:
    """Fit lobes to a histogram (T,); returns the model and its shares per bin (T,)."""
    bins = counts.numel()
    data = (counts - counts.median()).clamp_min(0)
    data = data / data.sum()
    smooth = torch.nn.functional.avg_pool1d(data[None, None], 3, 1, 1).reshape(1, bins, 1, 1)
    found = sensing.multi_return(
        smooth, lobes, threshold=0.02 * float(smooth.max()), min_separation_bins=max(3, round(100e-12 / bin_width_s))
    )
    starts = [
        float(p) * bin_width_s for p, ok in zip(found.position.flatten(), found.valid.flatten(), strict=True) if ok
    ]
    heights = [float(s) for s, ok in zip(found.strength.flatten(), found.valid.flatten(), strict=True) if ok]
    model = Lobes(starts, heights, fwhm_s=5 * bin_width_s, tail_s=8 * bin_width_s)
    edges = torch.arange(bins + 1, dtype=torch.float64) * bin_width_s
    # Adam's steps are as large as the learning rate: delays are in units of a tenth of a picosecond, logarithms of one.
    floor = 1e-3 * float(data.max())

    def loss_of() -> Tensor:
        return (stabilized(model.mass(edges), floor) - stabilized(data, floor)).square().sum()

    delays = [p for n, p in model.named_parameters() if n.endswith("delay_ps")]
    others = [p for n, p in model.named_parameters() if not n.endswith("delay_ps")]
    groups = [{"params": delays, "lr": 0.1 * bin_width_s * 1e12}, {"params": others}]
    descend(groups, loss_of, steps, 0.05, "impulse response")
    with torch.no_grad():
        return model, model.mass(edges)


class Zones(nn.Module):
    """One response for all zones; arrivals, brightness and background of each."""

    def __init__(self, histograms: Tensor, bin_width_s: float) -> None:
        super().__init__()
        zones = histograms.shape[0]
        peaks = histograms.argmax(1).double() + 0.5
        self.bin_width_s = bin_width_s
        self.log_fwhm_bins = nn.Parameter(torch.tensor(math.log(3.0), dtype=torch.float64))
        self.log_tail_bins = nn.Parameter(torch.tensor(math.log(4.0), dtype=torch.float64))
        self.arrival_bins = nn.Parameter(peaks - 1.0)
        self.log_brightness = nn.Parameter(histograms.sum(1).clamp_min(1).log())
        self.log_background = nn.Parameter(torch.full((zones,), math.log(1.0), dtype=torch.float64))

    def forward(self, bins: int) -> Tensor:
        """(zones, T): the model's histograms."""
        edges = torch.arange(bins + 1, dtype=torch.float64)
        sigma = self.log_fwhm_bins.exp() / sensing.responses.FWHM_PER_SIGMA
        cdf = sensing.emg_cdf(
            edges.expand(len(self.arrival_bins), -1), self.arrival_bins[:, None], sigma, self.log_tail_bins.exp()
        )
        return self.log_brightness.exp()[:, None] * cdf.diff(dim=1) + self.log_background.exp()[:, None]


def fit_zones(histograms: Tensor, bin_width_s: float, steps: int) -> tuple[Zones, Tensor, Tensor]:
    """Fit all zones (Z, T) at once; returns the model, its histograms, and the bins (Z, T) that were looked at."""
    lit = histograms.sum(0) > 0
    first, last = (int(x) for x in torch.nonzero(lit).flatten()[[0, -1]])
    # What the chip blanks before and after is no measurement of zero.
    seen = torch.zeros_like(histograms, dtype=torch.bool)
    seen[:, first : last + 1] = True
    model = Zones(histograms, bin_width_s)
    floor = 1e-2 * float(histograms.max())

    def loss_of() -> Tensor:
        difference = stabilized(model(histograms.shape[1]), floor) - stabilized(histograms, floor)
        return difference[seen].square().mean()

    descend(list(model.parameters()), loss_of, steps, 0.05, "zones")
    with torch.no_grad():
        return model, model(histograms.shape[1]), seen


def draw(panels: list[tuple[str, Tensor, Tensor, float]], path: Path) -> None:
    """Measured and fitted histograms, with what is left over below."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2 * len(panels), 5.2), layout="constrained")
    axes = figure.subplots(2, len(panels), squeeze=False, height_ratios=[3, 1], sharex="col")
    for column, (title, data, model, width_ps) in enumerate(panels):
        peak = float(data.max())
        time_ns = (np.arange(data.numel()) + 0.5) * width_ps / 1000
        shown = data > 0
        upper, lower = axes[0, column], axes[1, column]
        upper.semilogy(time_ns[shown.numpy()], (data / peak)[shown], ".", markersize=3, color="0.5", label="measured")
        upper.semilogy(time_ns, (model / peak).clamp_min(1e-6), color="tab:blue", linewidth=1.2, label="fitted")
        upper.set(title=title, ylim=(5e-4, 2), ylabel="share of the highest bin")
        upper.legend(fontsize=8)
        lower.plot(time_ns, (data - model) / peak, color="tab:red", linewidth=0.8)
        lower.set(xlabel="time in ns", ylabel="residual")
        busy = torch.nonzero(model > 0.003 * peak).flatten()
        lower.set_xlim(time_ns[int(busy[0])] - 0.1, time_ns[int(busy[-1])] + 0.1)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)


def main(argv: Sequence[str] | None = None) -> dict[str, float]:
    """Command line; returns the figures that it prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--irf", type=Path, help="measured impulse response, .npy (T,)")
    parser.add_argument("--bin-width-ps", type=float, default=8.0, help="its bins (%(default)s)")
    parser.add_argument("--lobes", type=int, default=4, help="lobes of the model at most (%(default)s)")
    parser.add_argument("--frames", type=Path, nargs="+", default=[], help="frames of a chip, .npz with hists (Z, T)")
    parser.add_argument("--frame-bin-ps", type=float, default=250.0, help="their bins (%(default)s)")
    parser.add_argument("--steps", type=int, default=800, help="steps of each fit (%(default)s)")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="folder for the picture (%(default)s)")
    parser.add_argument("--smoke", action="store_true", help="small enough for seconds: coarse, shows that it runs")
    if parser.parse_known_args(argv)[0].smoke:
        parser.set_defaults(steps=80, lobes=2)
    options = parser.parse_args(argv)
    if options.irf is None and not options.frames:
        parser.error("give --irf, --frames or both")
    torch.manual_seed(0)
    figures: dict[str, float] = {}
    panels: list[tuple[str, Tensor, Tensor, float]] = []
    if options.irf is not None:
        counts = torch.from_numpy(np.load(options.irf)).double().flatten()
        if int(counts.argmax()) < BEFORE // 2:
            counts = counts.roll(BEFORE)  # a periodic record that starts with its peak: what came before is at its end
        model, fitted = fit_response(counts, options.bin_width_ps * 1e-12, options.lobes, options.steps)
        shares = (counts - counts.median()).clamp_min(0)
        shares = shares / shares.sum()
        residual = (fitted - shares) / shares.max()
        figures["irf_rms_percent"] = 100 * float(residual[shares > 0].square().mean().sqrt())
        figures["irf_variation_percent"] = 50 * float((fitted - shares).abs().sum())
        print(f"impulse response {options.irf.name}:")
        print("\n".join(model.describe()))
        print(
            f"  residual {figures['irf_rms_percent']:.2f} % of the peak rms, "
            f"{figures['irf_variation_percent']:.1f} % of the light in wrong bins"
        )
        brightest = model.lobes[int(model.shares.argmax())]
        figures["irf_fwhm_ps"] = float(brightest.fwhm_s.detach()) * 1e12
        figures["irf_tail_ps"] = float(brightest.tails_s[0].detach()) * 1e12
        panels.append(("impulse response", shares, fitted, options.bin_width_ps))
    if options.frames:
        histograms = torch.cat([torch.from_numpy(np.load(f)["hists"]).double() for f in options.frames])
        histograms = histograms[histograms.sum(1) > 0]
        zones, fitted, seen = fit_zones(histograms, options.frame_bin_ps * 1e-12, options.steps)
        peak = histograms.amax(1, keepdim=True)
        residual = ((fitted - histograms) / peak)[seen]
        figures["zone_fwhm_ps"] = math.exp(float(zones.log_fwhm_bins.detach())) * options.frame_bin_ps
        figures["zone_tail_ps"] = math.exp(float(zones.log_tail_bins.detach())) * options.frame_bin_ps
        figures["zone_rms_percent"] = 100 * float(residual.square().mean().sqrt())
        print(
            f"{histograms.shape[0]} zones of {len(options.frames)} frames: width {figures['zone_fwhm_ps']:.0f} ps, "
            f"tail {figures['zone_tail_ps']:.0f} ps, residual {figures['zone_rms_percent']:.1f} % of each peak rms"
        )
        brightest_zone = int(histograms.sum(1).argmax())
        inside = seen[brightest_zone]
        panels.append(
            (
                "brightest zone",
                histograms[brightest_zone] * inside,
                fitted[brightest_zone] * inside,
                options.frame_bin_ps,
            )
        )
    picture = options.output / "calibrate_irf.png"
    draw(panels, picture)
    print(f"calibrate_irf: {picture}")
    return figures


if __name__ == "__main__":
    main()

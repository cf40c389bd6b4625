"""How far depth estimates are from the Cramer-Rao bound: the table of docs/photon_counting.md.

    python docs/make_depth_bounds.py

Planes at all places inside a bin; root of the mean square of the error over the bound of each (`tt.sensing.crlb`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import torch
from torch import Tensor

import torchtransient as tt
from torchtransient import sensing

PAGE = Path(__file__).parent / "photon_counting.md"
MARKS = ("<!-- bounds:begin -->", "<!-- bounds:end -->")
PS = 1e-12
AXIS = tt.TimeAxis.from_seconds(0.0, 100 * PS, 96)
DRAWS = 2000
PHOTONS = (10, 30, 100, 1000)
CYCLES, SIGNALS = 2000, (0.05, 0.5, 2.0, 8.0)


def named(unknowns: Iterable[Tensor]) -> dict[str, Tensor]:
    """Distance, signal and background as arguments."""
    return dict(zip(("distance_m", "signal", "background"), unknowns, strict=True))


def planes(generator: torch.Generator) -> Tensor:
    """Metres of places between bins 30 and 60."""
    return 0.5 * AXIS.bin_width_opl * (30 + 30 * torch.rand(DRAWS, generator=generator, dtype=torch.float64))


# full widths at half maximum, and mean delays of tails, in bins
RESPONSES: dict[str, Callable[[], sensing.Response]] = {
    "0.6": lambda: sensing.GaussianResponse(60 * PS),
    "1": lambda: sensing.GaussianResponse(100 * PS),
    "5": lambda: sensing.GaussianResponse(500 * PS),
    "2, tail of 2": lambda: sensing.emg_response(200 * PS, 200 * PS),
    "2, tail of 4": lambda: sensing.emg_response(200 * PS, 400 * PS),
    "0.6, tail of 4": lambda: sensing.emg_response(60 * PS, 400 * PS),
    "5, rectangle": lambda: sensing.UniformResponse(500 * PS),
}
WITHOUT_TAILS = ("0.6", "1", "5")


def columns(x: Tensor) -> Tensor:
    """(1, T, 1, N) of (N, T)."""
    return x.T.reshape(1, x.shape[1], 1, -1)


def matched(counts: Tensor, response: sensing.Response, ratio: float) -> Tensor:
    first, kernel = response.kernel(AXIS.bin_width_s)
    scores = sensing.log_matched_filter(counts, kernel, first, signal_to_background=ratio)
    return sensing.distance_of_position(sensing.peak_position(scores), AXIS).flatten()


def greatest(counts: Tensor, response: sensing.Response, ratio: float) -> Tensor:
    place = sensing.ml_position(counts, response, AXIS, signal_to_background=ratio)
    return sensing.distance_of_position(place, AXIS).flatten()


def centre(counts: Tensor, background: float) -> Tensor:
    place = sensing.center_of_mass(counts, background=background, half_width_bins=6)
    return sensing.distance_of_position(place, AXIS).flatten()


def likeliest(counts: Tensor, response: sensing.Response, signal: float, background: float) -> Tensor:
    """The distance of the least `first_photon_nll`, all three unknown: from the best bin with the power that is known
    about, by steps of the inverse of the information.
    """
    bins = 0.5 * AXIS.centers_opl[20:70]
    rates = sensing.return_rates(response, AXIS, distance_m=bins, signal=signal, background=background)
    least = [tt.losses.first_photon_nll(columns(r.expand(DRAWS, -1)), counts, CYCLES, reduction="none").sum(1)
             for r in rates]  # fmt: skip
    start = bins[torch.stack(least).flatten(1).argmin(0)]
    found = torch.stack([start, torch.full_like(start, signal), torch.full_like(start, background)], -1)
    for _ in range(8):
        leaf = found.clone().requires_grad_()
        model = columns(sensing.return_rates(response, AXIS, **named(leaf.unbind(-1))))
        loss = tt.losses.first_photon_nll(model, counts, CYCLES, reduction="sum")
        (slope,) = torch.autograd.grad(loss, leaf)
        covariance = sensing.crlb(response, AXIS, **named(found.unbind(-1)), cycles=CYCLES).covariance
        found = torch.maximum(found - (covariance @ slope[..., None])[..., 0], 0.3 * found)
    return found[:, 0]


def ratio_of(found: Tensor, truth: Tensor, bound: Tensor) -> str:
    value = float(((found - truth) / bound).square().mean().sqrt())
    return f"{value:.2f}" if value < 10 else f"{value:.0f}"


def without_pile_up() -> list[str]:
    """Poisson counts: response, background per bin, and each number of photons."""
    lines = []
    ways: dict[str, Callable[[Tensor, sensing.Response, float, float], Tensor]] = {
        "`ml_position`": lambda x, r, n, b: greatest(x, r, n / b if b else 1e3),
        "matched filter, parabola": lambda x, r, n, b: matched(x, r, n / b if b else 1e3),
        "centre of mass, 6 bins": lambda x, r, n, b: centre(x, b),
    }
    for way, estimate in ways.items():
        widths = WITHOUT_TAILS if "centre" in way else tuple(RESPONSES)
        for width, background in ((w, b) for w in widths for b in (0.0, 0.05, 0.6)):
            response, row = RESPONSES[width](), []
            for photons in PHOTONS:
                g = torch.Generator().manual_seed(1)
                truth = planes(g)
                mean = sensing.return_rates(response, AXIS, distance_m=truth, signal=photons, background=background)
                counts = torch.poisson(columns(mean), generator=g)
                bound = sensing.crlb(response, AXIS, distance_m=truth, signal=photons, background=background).distance_m
                row.append(ratio_of(estimate(counts, response, photons, background), truth, bound))
            lines.append(f"| {way} | {width} | {background:g} | " + " | ".join(row) + " |")
    return lines


def with_pile_up() -> list[str]:
    """First photons of 2000 cycles: of the histogram, of Coates' estimate, and by maximum likelihood."""
    response, background = sensing.GaussianResponse(5 * AXIS.bin_width_s), 2e-3
    rows: dict[str, list[str]] = {
        "matched filter of the counts": [],
        "matched filter of `coates`": [],
        "least `first_photon_nll`": [],
    }
    for signal in SIGNALS:
        g = torch.Generator().manual_seed(2)
        truth = planes(g)
        rates = columns(sensing.return_rates(response, AXIS, distance_m=truth, signal=signal, background=background))
        counts = sensing.SynchronousSPAD(CYCLES).sample(rates, g)
        bound = sensing.crlb(
            response, AXIS, distance_m=truth, signal=signal, background=background, cycles=CYCLES
        ).distance_m
        undone = matched(sensing.coates(counts, CYCLES).rate, response, signal / background)
        found = {
            "matched filter of the counts": matched(counts, response, signal / background),
            "matched filter of `coates`": undone,
            "least `first_photon_nll`": likeliest(counts, response, 0.8 * signal, 1.3 * background),
        }
        for name, estimate in found.items():
            rows[name].append(ratio_of(estimate, truth, bound))
    return [f"| {name} | " + " | ".join(row) + " |" for name, row in rows.items()]


def page() -> str:
    head = ["| estimate | width of the response in bins | background in a bin | "
            + " | ".join(f"{n} photons" for n in PHOTONS) + " |", "|---" * (3 + len(PHOTONS)) + "|"]  # fmt: skip
    piled = ["", "| first photons of 2000 cycles, 0.002 background in a bin | "
             + " | ".join(f"{s:g} in a cycle" for s in SIGNALS) + " |", "|---" * (1 + len(SIGNALS)) + "|"]  # fmt: skip
    return "\n".join([MARKS[0], *head, *without_pile_up(), *piled, *with_pile_up(), MARKS[1]])


if __name__ == "__main__":
    text = PAGE.read_text(encoding="utf-8")
    begin, end = text.index(MARKS[0]), text.index(MARKS[1]) + len(MARKS[1])
    PAGE.write_text(text[:begin] + page() + text[end:], encoding="utf-8")

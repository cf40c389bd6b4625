"""Draw the figures of docs/sensors.md: `python docs/make_sensor_figures.py [PART ...]`, a minute on two cores.

The light is computed here in closed form (a ball before a slanted wall, or single pulses), so that every difference
in a figure is the sensor's. The two figures of the training examples are drawn by those.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from pathlib import Path

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

import torchtransient as tt
from torchtransient import sensing
from torchtransient.units import SPEED_OF_LIGHT

OUT = Path(__file__).parent / "images" / "sensors"
PS, NS = 1e-12, 1e-9


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def sheet(columns: int, width: float = 3.4, height: float = 2.9) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(width * columns, height), layout="constrained")
    return figure, list(figure.subplots(1, columns, squeeze=False)[0])


def save(figure: Figure, name: str) -> None:
    OUT.mkdir(parents=True, exist_ok=True)
    figure.savefig(OUT / name, dpi=90)


def column(values: Tensor) -> Tensor:
    """A histogram (T,) as a transient (1, T, 1, 1)."""
    return values.reshape(1, -1, 1, 1)


def pulse(axis: tt.TimeAxis, time_s: float, fwhm_s: float) -> Tensor:
    """(T,) normal pulse of area one."""
    return sensing.GaussianResponse(fwhm_s, delay_s=time_s).mass(axis.edges_s)


def ball(size: int = 96) -> tuple[Tensor, Tensor]:
    """Distance in metres (H, W) and reflected light (H, W) of a ball before a slanted wall, seen and lit from 0."""
    v, u = torch.meshgrid(*(torch.linspace(-0.5, 0.5, size, dtype=torch.float64),) * 2, indexing="ij")
    ray = torch.stack([u, v, torch.ones_like(u)], -1)
    ray = ray / ray.norm(dim=-1, keepdim=True)
    centre, radius = torch.tensor([0.1, 0.05, 2.0], dtype=torch.float64), 0.55
    normal = torch.tensor([0.35, 0.0, -1.0], dtype=torch.float64)
    normal = normal / normal.norm()
    wall = (torch.tensor([0.0, 0.0, 3.2], dtype=torch.float64) @ normal) / (ray @ normal)
    along = ray @ centre
    root = along.square() - centre.square().sum() + radius**2
    hit = root > 0
    near = along - root.clamp_min(0).sqrt()
    distance = torch.where(hit, near, wall)
    facing_ball = -((ray * near[..., None] - centre) / radius * ray).sum(-1)
    facing = torch.where(hit, facing_ball, -(ray @ normal)).clamp_min(0)
    return distance, facing / distance.square()


def transient(axis: tt.TimeAxis, distance: Tensor, light: Tensor) -> Tensor:
    """(1, T, H, W): each pixel's light in the two bins around its time of flight."""
    place = (2 * distance - axis.start_opl) / axis.bin_width_opl - 0.5
    low = place.floor()
    x = torch.zeros(1, axis.num_bins, *distance.shape, dtype=distance.dtype)
    for k, share in ((low, low + 1 - place), (low + 1, place - low)):
        inside = (k >= 0) & (k < axis.num_bins)
        index = torch.where(inside, k, 0).long()
        x.scatter_add_(1, index[None, None], torch.where(inside, share * light, 0.0)[None, None])
    return x


def responses() -> None:
    """Impulse responses: shapes, and one laid over two returns."""
    axis = tt.TimeAxis.from_seconds(-0.5 * NS, 4 * PS, 500)
    figure, (left, right) = sheet(2, 4.2)
    time_ns = axis.centers_s / NS
    shapes = {
        "normal, 60 ps": sensing.GaussianResponse(60 * PS),
        "one tail of 90 ps": sensing.emg_response(60 * PS, 90 * PS),
        "30 % in a tail of 90 ps": sensing.TailedResponse(60 * PS, [90 * PS], [0.3]),
        "composed with a 100 ps window": sensing.ComposedResponse(
            [sensing.TailedResponse(60 * PS, [90 * PS], [0.3]), sensing.UniformResponse(100 * PS)]
        ),
    }
    for name, shape in shapes.items():
        first, kernel = shape.kernel(4 * PS)
        left.semilogy((torch.arange(kernel.numel()) + first) * 0.004, kernel.detach(), label=name)
    left.set(
        title="impulse responses",
        xlabel="delay in ns",
        ylabel="share of a 4 ps bin",
        ylim=(1e-6, 0.1),
        xlim=(-0.2, 1.2),
    )
    left.legend(fontsize=7)
    x = torch.zeros(500, dtype=torch.float64)
    x[150], x[200] = 1.0, 0.4
    y = sensing.ImpulseResponse(shapes["one tail of 90 ps"], axis)(column(x)).flatten()
    right.plot(time_ns, x / 20, color="0.7", label="light, over 20")
    right.plot(time_ns, y, label="behind the response")
    right.set(title="two returns, 200 ps apart", xlabel="time in ns", xlim=(0, 1))
    right.legend(fontsize=8)
    save(figure, "responses.png")


def pile_up() -> None:
    """First-photon histograms in growing light, and what Coates makes of them."""
    axis = tt.TimeAxis.from_seconds(0.0, 100 * PS, 256)
    base = pulse(axis, 14 * NS, 600 * PS) * 0.25 + 0.75 / 256
    figure, panels = sheet(3)
    for panel, photons in zip(panels, (0.05, 1.0, 4.0), strict=True):
        rate = column(base * photons)
        spad = sensing.SynchronousSPAD(20_000, grad="straight_through")
        counts = spad(rate, generator(1))
        fixed, valid = spad.inverse(counts)
        time_ns = axis.centers_s / NS
        panel.step(time_ns, counts.flatten() / 20_000, color="0.6", linewidth=0.8, label="histogram")
        kept = valid.flatten()
        panel.step(time_ns[kept], fixed.flatten()[kept], color="tab:orange", linewidth=0.8, label="Coates")
        panel.plot(time_ns, rate.flatten(), color="tab:blue", linewidth=1.0, label="photons")
        low, high = float(rate.min()), float(rate.max())
        panel.set(title=f"{photons:g} photons per cycle", xlabel="time in ns", yscale="log", ylim=(low / 30, 3 * high))
    panels[0].set_ylabel("per cycle and bin")
    panels[0].legend(fontsize=8)
    save(figure, "pile_up.png")


def order_of_effects() -> None:
    """Jitter before and behind pile-up; ambient light before and behind the budget."""
    axis = tt.TimeAxis.from_seconds(0.0, 20 * PS, 128)
    response = sensing.TailedResponse(50 * PS, [90 * PS], [0.3])
    light = column(6 * pulse(axis, 1.2 * NS, 60 * PS))
    spad, jitter = sensing.SynchronousSPAD(1), sensing.DetectionJitter(response, axis)
    spread = sensing.ImpulseResponse(response, axis)
    figure, (left, right) = sheet(2, 4.2)
    time_ns = axis.centers_s / NS
    left.plot(time_ns, light.flatten() / 6, color="0.7", label="light")
    left.plot(time_ns, jitter.expected(spad.expected(light)).flatten(), label="jitter behind the detector")
    left.plot(time_ns, spad.expected(spread(light)).flatten(), "--", label="in front of it: too early")
    left.set(title="6 photons a cycle", xlabel="time in ns", ylabel="share of cycles", xlim=(0.9, 1.9))
    left.legend(fontsize=8)
    ambient = column(torch.full((128,), 1e-3, dtype=torch.float64) + 0.2 * pulse(axis, 1.5 * NS, 60 * PS))
    signal = ambient - 1e-3
    right.plot(time_ns, (spread(signal) + 1e-3).flatten() * 1e3, label="background added behind the response")
    right.plot(time_ns, spread(ambient).flatten() * 1e3, "--", label="in front of it: edges starve")
    right.set(title="ambient light", xlabel="time in ns", ylabel="detections in 1000 cycles", ylim=(0, 3))
    right.legend(fontsize=8)
    save(figure, "order_of_effects.png")


def dead_time() -> None:
    """Free-running detectors: shape and rate."""
    axis = tt.TimeAxis.from_seconds(0.0, 200 * PS, 250)
    rate = column(pulse(axis, 20 * NS, 1 * NS) * 1.0 + 1.0 / 250)
    figure, (left, right) = sheet(2, 4.2)
    time_ns = axis.centers_s / NS
    left.plot(time_ns, rate.flatten() / rate.sum(), color="0.7", label="photons")
    for dead_ns in (10.0, 30.0, 75.0):
        y = sensing.FreeRunningSPAD(1, dead_ns * NS, axis=axis).expected(rate).flatten()
        left.plot(time_ns, y / y.sum(), linewidth=0.9, label=f"dead for {dead_ns:g} ns")
    left.set(title="free-running, 2 photons per 50 ns", xlabel="time in ns", ylabel="share of detections", yscale="log")
    left.legend(fontsize=7)
    incident = torch.logspace(5, 9.3, 100, dtype=torch.float64)
    for kind, label in (("non_paralyzable", "non-paralyzable"), ("paralyzable", "paralyzable")):
        right.loglog(incident, sensing.free_running_rate(incident, 50 * NS, kind), label=label)
    right.loglog(incident, incident, color="0.7", linewidth=0.8, label="no dead time")
    right.set(title="dead time of 50 ns", xlabel="photons per second", ylabel="counts per second", ylim=(1e5, 1e8))
    right.legend(fontsize=8)
    save(figure, "dead_time.png")


def after_detection() -> None:
    """Afterpulses, unequal codes of a converter, crosstalk."""
    axis = tt.TimeAxis.from_seconds(0.0, 100 * PS, 500)
    x = column(1e5 * pulse(axis, 5 * NS, 500 * PS) + 0.5)
    figure, (one, two, three) = sheet(3)
    y = sensing.Afterpulsing(0.03, 8 * NS, 10 * NS, axis=axis).expected(x)
    one.semilogy(axis.centers_s / NS, x.flatten(), label="detections")
    one.semilogy(axis.centers_s / NS, y.flatten(), label="with afterpulses")
    one.set(title="afterpulses: 3 %, 8 ns", xlabel="time in ns", ylabel="counts", ylim=(0.2, 3e4))
    one.legend(fontsize=8)
    flat = torch.full((1, 64, 1, 1), 1000.0, dtype=torch.float64)
    widths = sensing.random_code_widths(64, 0.1, generator(2))
    two.step(range(64), sensing.TDC(widths)(flat).flatten(), label="converter")
    two.step(range(64), sensing.TDC(widths, sliding_scale=16)(flat).flatten(), label="sliding scale of 16")
    two.set(title="codes of unequal width (10 %)", xlabel="code", ylabel="counts of even light", ylim=(600, 1400))
    two.legend(fontsize=8)
    spots = torch.zeros(1, 1, 9, 9, dtype=torch.float64)
    spots[..., 4, 4] = 1
    image = sensing.Crosstalk(0.02, diagonal_ratio=0.4).expected(spots)[0, 0]
    shown = three.imshow(image.clamp_min(1e-4).log10(), cmap="magma")
    figure.colorbar(shown, ax=three, label="log10 of the counts")
    three.set(title="crosstalk: 2 %", xticks=[], yticks=[])
    save(figure, "after_detection.png")


def macro_pixels() -> None:
    """A zone of SPADs against one, coincidences, and afterpulses by three laws."""
    axis = tt.TimeAxis.from_seconds(0.0, 250 * PS, 128)
    x = column(3 * pulse(axis, 18 * NS, 1 * NS) + 3 / 128)
    figure, (one, two, three) = sheet(3)
    spad = sensing.SynchronousSPAD(1, dead_time_s=10 * NS, axis=axis)
    times = axis.centers_s / NS
    one.plot(times, x.flatten(), "0.6", lw=4, label="light")
    one.plot(times, sensing.MacroPixel(spad, 100)(x).flatten(), label="100 SPADs")
    one.plot(times, spad(x).flatten(), label="one SPAD")
    one.set(title="6 photons a cycle, 3 of the pulse", xlabel="time in ns", ylabel="detections per cycle")
    one.legend(fontsize=8)
    for k in (1, 2, 3):
        seen = sensing.CoincidencePixel(spad, 16, coincidence=k, window_s=2 * NS, axis=axis)(x).flatten()
        two.semilogy(times, seen / seen.max(), label=f"{k} of 16 SPADs")
    two.set(title="coincidences within 2 ns", xlabel="time in ns", ylabel="of the peak", ylim=(1e-4, 2))
    two.legend(fontsize=8)
    fine = tt.TimeAxis.from_seconds(0.0, 1 * NS, 3000)
    laws = {
        "one exponential": sensing.Afterpulsing(0.02, 100 * NS, 20 * NS, axis=fine),
        "two exponentials": sensing.Afterpulsing([0.012, 0.008], [30 * NS, 400 * NS], 20 * NS, axis=fine),
        "power law": sensing.Afterpulsing(
            0.02, dead_time_s=20 * NS, delays=sensing.PowerLawDelays(1.2, 3e-6), axis=fine
        ),
    }
    for name, law in laws.items():
        three.loglog(fine.edges_s[1:] / NS, law.first_kernel(3000), label=name)
    three.set(title="afterpulses: 2 %, dead for 20 ns", xlabel="ns after the detection", ylabel="in 1 ns")
    three.set(xlim=(15, 3000), ylim=(1e-8, 2e-3))
    three.legend(fontsize=8)
    save(figure, "macro_pixels.png")


def itof_codes() -> None:
    """Correlation codes, and wiggling."""
    x = torch.linspace(0, 1, 721, dtype=torch.float64)
    codes = {
        "sine, 4 taps": sensing.sine_code(4),
        "square, 4 taps": sensing.square_code(4),
        "Hamiltonian, 3 taps": sensing.hamiltonian_code(3),
        "Hamiltonian, 4 taps": sensing.hamiltonian_code(4),
    }
    figure, panels = sheet(5, 3.0)
    for panel, (name, code) in zip(panels, codes.items(), strict=False):
        panel.plot(x, code.evaluate(x).T)
        panel.set(title=name, xlabel="phase in turns")
    panels[0].set_ylabel("weight of the tap")
    last = panels[-1]
    for taps in (3, 4, 5, 8):
        light = (1 + sensing.square_code(taps).evaluate(x)).reshape(1, taps, 1, -1)
        phase = sensing.phase_of(sensing.tap_phasor(light, taps)).flatten()
        last.plot(x, 1000 * sensing.wrapped_difference(phase, 2 * math.pi * x), label=f"{taps} taps", linewidth=0.9)
    last.set(title="wiggling, square codes", xlabel="phase in turns", ylabel="phase error in mrad")
    last.legend(fontsize=7, ncols=2)
    save(figure, "itof_codes.png")


def itof_depth() -> None:
    """A noisy iToF camera: one frequency, two frequencies, and light that took two paths."""
    axis = tt.TimeAxis(0.0, 0.02, 500)
    distance, light = ball()
    x = transient(axis, distance, light)
    figure, panels = sheet(4, 3.3)
    views = {"true distance": distance}
    noise = sensing.PixelElectronics(
        read_noise_e=20.0, full_well_e=1e5, gain_e_per_dn=30.0, bits=12, grad="straight_through"
    )
    for name, frequencies in (("80 MHz", (80e6,)), ("80 and 60 MHz", (80e6, 60e6))):
        camera = sensing.ItofCorrelation(
            sensing.sine_code(4), frequencies, axis, contrast=0.6, background_e=2000.0, electrons_per_unit=3e4
        )
        taps = noise(camera(x), generator(0))
        views[name] = sensing.read_itof(
            taps, frequencies, 4, max_depth_m=5.0 if len(frequencies) > 1 else None
        ).depth_m[0]
    for panel, (name, image) in zip(panels, views.items(), strict=False):
        shown = panel.imshow(image, vmin=0, vmax=4.2, cmap="viridis")
        panel.set(title=name, xticks=[], yticks=[])
    figure.colorbar(shown, ax=panels[2], label="metres")
    share = torch.linspace(0, 0.9, 60, dtype=torch.float64)
    second = torch.zeros(1, 500, 1, 60, dtype=torch.float64)
    second[0, 150] = 1
    for extra_m, colour in ((0.3, "tab:blue"), (0.8, "tab:orange")):
        y = second.clone()
        y[0, 150 + round(2 * extra_m / 0.02), 0] = share
        for f, style in ((20e6, "--"), (80e6, "-")):
            taps = sensing.ItofCorrelation(sensing.sine_code(4), f, axis).expected(y)
            error = sensing.read_itof(taps, f, 4).depth_m.flatten() - 1.505
            panels[3].plot(share, 1000 * error, color=colour, linestyle=style, label=f"+{extra_m:g} m, {f / 1e6:g} MHz")
    panels[3].set(title="a second path", xlabel="its light over the first's", ylabel="error in mm")
    panels[3].legend(fontsize=7)
    save(figure, "itof_depth.png")


def itof_pixels() -> None:
    """Noise of the readouts, drawn and in closed form; a camera whose pixels differ, with and without calibration."""
    figure, panels = sheet(4, 3.3)
    axis = tt.TimeAxis(0.0, 0.02, 500)
    levels = torch.logspace(2.5, 5, 9, dtype=torch.float64)
    x = torch.zeros(1, 500, 1, 1, dtype=torch.float64)
    x[0, 150] = 1.0
    for (readout, ambient), colour in zip(
        [(r, b) for r in ("single", "differential") for b in (0.0, 20_000.0)], ("C0", "C1", "C2", "C3"), strict=True
    ):
        code = sensing.sine_code(4) if readout == "single" else sensing.TwoTapCode(sensing.sine_code(4))
        camera = sensing.ItofCorrelation(code, 60.6e6, axis, contrast=0.6, background_e=ambient)
        chain = [sensing.PixelElectronics(read_noise_e=20.0)]
        chain += [sensing.TapDifference()] if readout == "differential" else []
        drawn = []
        for level in levels.tolist():
            taps = camera.expected(level * x).expand(1, -1, 1, 4000)
            frames = sensing.Compose(chain).sample(taps, generator(3))
            phase = sensing.read_itof(frames, 60.6e6, 4, readout=readout).phase.flatten()
            drawn.append(float(sensing.wrapped_difference(phase, phase[:1] * 0 + 2 * math.pi * 0.6084).std()))
        theory = sensing.phase_noise_rad(
            0.6 * levels / 4, (levels + ambient) / 4, 4, read_noise_e=20.0, readout=readout
        )
        metres = SPEED_OF_LIGHT / (4 * math.pi * 60.6e6)
        label = f"{readout}, {ambient:g} e of background"
        panels[0].loglog(levels, 1000 * metres * theory, colour, label=label)
        panels[0].loglog(levels, 1000 * metres * torch.tensor(drawn), colour + "o", markersize=3)
    panels[0].set(title="four steps, 60.6 MHz", xlabel="electrons of light", ylim=(0.3, 800))
    panels[0].set_ylabel("deviation of depth in mm")
    panels[0].legend(fontsize=7, loc="lower left")
    distance, light = ball()
    rows = torch.linspace(-1, 1, 96, dtype=torch.float64)
    pattern = 0.15 * rows[:, None] * rows + 0.02 * torch.randn(96, 96, generator=generator(4), dtype=torch.float64)
    known = sensing.ItofCalibration(phase_offset_rad=0.3, direction=-1, depth_map_m=pattern)
    camera = sensing.Compose(
        [
            sensing.ItofCorrelation(
                sensing.TwoTapCode(sensing.sine_code(4)), (80e6, 60e6), axis, contrast=0.6, background_e=2000.0,
                electrons_per_unit=6e4, calibration=known,
            ),
            sensing.PixelElectronics(read_noise_e=20.0),
            sensing.TapDifference(),
        ]
    )  # fmt: skip
    frames = camera.sample(transient(axis, distance, light), generator(0))
    right = sensing.ItofCalibration(phase_offset_rad=0.3, direction=-1)
    for panel, (name, used) in zip(
        panels[1:], {"no map": right, "with its map": known, "steps taken the wrong way": None}.items(), strict=True
    ):
        found = sensing.read_itof(
            frames, (80e6, 60e6), 4, readout="differential", calibration=used, max_depth_m=5.0
        ).depth_m[0]
        shown = panel.imshow(1000 * (found - distance), vmin=-200, vmax=200, cmap="RdBu_r", interpolation="nearest")
        panel.set(title=name, xticks=[], yticks=[])
    figure.colorbar(shown, ax=panels[3], label="error of depth in mm")
    save(figure, "itof_pixels.png")


def electronics() -> None:
    """Photon transfer curve with saturation, and the range of phase noise."""
    light = torch.logspace(0, 4.6, 60, dtype=torch.float64)
    model = sensing.PixelElectronics(full_well_e=1e4, read_noise_e=5.0, gain_e_per_dn=2.7, bits=12, black_level_dn=16.0)
    flat = light.reshape(1, 60, 1, 1)
    draws = model.sample(flat.expand(1, 60, 1, 4000), generator(0))
    figure, (left, right) = sheet(2, 4.2)
    left.loglog(light, model.expected(flat).flatten(), label="mean")
    left.loglog(light, draws.mean(-1).flatten(), ".", markersize=3, label="mean of 4000 draws")
    left.set(title="full well of 10 000 electrons", xlabel="electrons that arrive", ylabel="electrons reported")
    left.legend(fontsize=8)
    right.loglog(light, model.variance(flat).flatten().sqrt(), label="closed form")
    right.loglog(light, draws.std(-1).flatten(), ".", markersize=3, label="4000 draws")
    right.set(title="noise", xlabel="electrons that arrive", ylabel="standard deviation", ylim=(1, 200))
    right.legend(fontsize=8)
    save(figure, "electronics.png")


def depth_estimators() -> None:
    """Estimators on one histogram, several returns, and the error against the bound."""
    axis = tt.TimeAxis.from_seconds(0.0, 100 * PS, 128)
    first, kernel = sensing.GaussianResponse(500 * PS).kernel(100 * PS)
    figure, (one, two, three) = sheet(3)
    mean = 60 * pulse(axis, 5.03 * NS, 500 * PS) + 0.6
    counts = column(torch.poisson(mean, generator=generator(3)))
    scores = sensing.log_matched_filter(counts, kernel, first, signal_to_background=100.0)
    one.step(range(128), counts.flatten(), color="0.6", linewidth=0.8, where="mid")
    places = {
        "centre of mass": sensing.center_of_mass(counts),
        "... background off": sensing.center_of_mass(counts, background=0.6),
        "matched filter": sensing.peak_position(scores),
        "first return": sensing.first_return(counts, 4.0).position.squeeze(-3),
    }
    for (name, place), colour in zip(places.items(), ("tab:red", "tab:orange", "tab:blue", "tab:green"), strict=True):
        one.axvline(float(place) - 0.5, color=colour, linewidth=1.0, label=name)
    one.set(title="60 photons, truth at bin 49.8", xlabel="bin", ylabel="counts", xlim=(30, 80))
    one.legend(fontsize=7)
    several = (
        200 * pulse(axis, 3 * NS, 500 * PS) + 80 * pulse(axis, 4.4 * NS, 500 * PS) + 120 * pulse(axis, 9 * NS, 500 * PS)
    )
    counts = column(torch.poisson(several + 0.5, generator=generator(1)))
    smooth = sensing.convolve_time(counts, kernel, first)
    found = sensing.multi_return(smooth, 3, threshold=5.0, min_separation_bins=6)
    two.step(range(128), counts.flatten(), color="0.6", linewidth=0.8, where="mid")
    two.plot(found.position.flatten() - 0.5, found.strength.flatten(), "v", color="tab:red", label="found")
    two.plot(smooth.flatten(), color="tab:blue", linewidth=0.9, label="smoothed")
    two.set(title="three returns", xlabel="bin")
    two.legend(fontsize=8)
    photons = torch.logspace(0.7, 3.5, 12)
    errors = []
    for k, n in enumerate(photons.tolist()):
        draws = torch.poisson(
            column(n * pulse(axis, 5.03 * NS, 500 * PS)).expand(1, 128, 1, 2000), generator=generator(k)
        )
        place = sensing.peak_position(sensing.log_matched_filter(draws, kernel, first))
        errors.append(float((sensing.distance_of_position(place, axis) - 2.515 * NS * SPEED_OF_LIGHT).std()))
    three.loglog(photons, [1000 * e for e in errors], "o", markersize=4, label="matched filter")
    three.loglog(photons, 1000 * sensing.range_deviation_m(500 * PS, photons), color="0.4", label="Cramer-Rao bound")
    three.set(title="deviation of the distance", xlabel="photons", ylabel="mm")
    three.legend(fontsize=8)
    save(figure, "depth_estimators.png")


def gates() -> None:
    """Gate profiles, and the pictures behind them."""
    axis = tt.TimeAxis(2.0, 0.02, 300)
    distance, light = ball()
    starts = [2 * d / SPEED_OF_LIGHT for d in (1.43, 1.62, 3.0)]
    gate = sensing.GatedIntegration(starts, 1.3 * NS, axis, rise_s=0.3 * NS, electrons_per_unit=2000.0)
    camera = sensing.Compose(
        [gate, sensing.PixelElectronics(excess_noise=1.6, read_noise_e=4.0)], grad="straight_through"
    )
    pictures = camera(transient(axis, distance, light), generator(0))[0]
    figure, panels = sheet(4, 3.2)
    panels[0].plot(axis.centers_opl / 2, gate.profiles().T)
    panels[0].set(title="three gates of 1.3 ns", xlabel="distance in metres", ylabel="transmission")
    for k, panel in enumerate(panels[1:]):
        panel.imshow(pictures[k], cmap="gray", vmin=0, vmax=float(pictures[k].max()))
        panel.set(title=f"gate {k + 1}, own scale", xticks=[], yticks=[])
    save(figure, "gates.png")


def streak() -> None:
    """One line of the scene through a streak camera."""
    axis = tt.TimeAxis(2.8, 0.006, 200)
    distance, light = ball(128)
    line = slice(67, 68)
    x = transient(axis, distance[line], light[line]) * 40
    camera = sensing.StreakCamera(
        axis, time_fwhm_s=60 * PS, spatial_fwhm_px=2.0, jitter_fwhm_s=30 * PS, sweeps=50, phosphor_fwhm_px=1.5,
        excess_noise=1.5, read_noise_e=0.05, grad="straight_through",
    )  # fmt: skip
    figure, panels = sheet(3, 3.6, 3.4)
    views = {
        "light": x,
        "mean of the camera": camera.expected(x),
        "one exposure": camera(x, generator(0)),
    }
    for panel, (name, image) in zip(panels, views.items(), strict=True):
        flat = image[0, :, 0]
        style = {"cmap": "magma", "vmax": float(flat.quantile(0.9995)) ** 0.5}
        # Smoothed cells would double the file: no two dots of the noise are then alike.
        panel.imshow(flat.clamp_min(0).sqrt(), aspect="auto", interpolation="nearest", **style)
        panel.set(title=name, xlabel="pixel along the slit", yticks=[])
    panels[0].set_ylabel("time, downwards (root of the light)")
    save(figure, "streak.png")


def polarization() -> None:
    """A glossy ball under unpolarized light: mosaic, and what comes back from it."""
    size = 96
    v, u = torch.meshgrid(*(torch.linspace(1.1, -1.1, size, dtype=torch.float64),) * 2, indexing="ij")
    u = -u
    r2 = u.square() + v.square()
    inside = r2 < 0.98
    sine2 = torch.where(inside, r2, 0.0)
    cosine, n = (1 - sine2).sqrt(), 1.5
    # Specular reflection of a dielectric (Atkinson & Hancock 2006): polarized across the plane of incidence.
    root = (n**2 - sine2).sqrt()
    degree = 2 * sine2 * cosine * root / (n**2 - sine2 - n**2 * sine2 + 2 * sine2**2)
    angle = torch.atan2(v, u) + math.pi / 2
    power = torch.where(inside, 1.0, 0.1) * 4000
    s = torch.stack(
        [torch.ones_like(u), degree * torch.cos(2 * angle), degree * torch.sin(2 * angle), torch.zeros_like(u)]
    )
    s = (s * power)[:, None, None]
    preset = sensing.device("imx250mzr_like")
    sensor = preset.sensor(grad="straight_through")
    raw = sensor(s, generator(0))
    back = sensor.stages[0].stokes(raw)
    figure, panels = sheet(5, 2.9)
    dolp, aolp = tt.stokes.degree_of_linear_polarization, tt.stokes.angle_of_linear_polarization
    views = [
        ("raw, 24 x 24 pixels", raw[0, 0, 20:44, 20:44], {"cmap": "gray"}),
        ("degree, true", dolp(s, -5)[0, 0], {"vmin": 0, "vmax": 1, "cmap": "viridis"}),
        ("degree, measured", dolp(back, -5)[0, 0], {"vmin": 0, "vmax": 1, "cmap": "viridis"}),
        ("angle, true", aolp(s, -5)[0, 0], {"vmin": -math.pi / 2, "vmax": math.pi / 2, "cmap": "hsv"}),
        ("angle, measured", aolp(back, -5)[0, 0], {"vmin": -math.pi / 2, "vmax": math.pi / 2, "cmap": "hsv"}),
    ]
    for panel, (name, image, style) in zip(panels, views, strict=True):
        panel.imshow(image, interpolation="nearest", **style)
        panel.set(title=name, xticks=[], yticks=[])
    save(figure, "polarization.png")


def beats() -> None:
    """A ball that turns about its vertical axis, seen by a coherent lidar: spectra of one pixel, speeds of all."""
    size, turns = 48, 4.0
    chirps = tt.Chirps(bandwidth_hz=1e9, duration_s=10e-6, wavelength_m=1550e-9)
    distance, light = ball(size)
    light = light / light.mean()
    v, u = torch.meshgrid(*(torch.linspace(-0.5, 0.5, size, dtype=torch.float64),) * 2, indexing="ij")
    ray = torch.stack([u, v, torch.ones_like(u)], -1)
    ray = ray / ray.norm(dim=-1, keepdim=True)
    arm = ray * distance[..., None] - torch.tensor([0.1, 0.05, 2.0], dtype=torch.float64)
    on_ball = arm.norm(dim=-1) < 0.551
    axis_of_ball = torch.tensor([0.0, turns, 0.0], dtype=torch.float64).expand_as(arm)
    speed = torch.where(on_ball, -(torch.linalg.cross(axis_of_ball, arm) * ray).sum(-1), 0.0)
    places = [2 * distance - sign * chirps.rate_scale_s * 2 * speed for sign in (1, -1)]
    limits = (1.0, 4.5), (-2.5, 2.5)
    axis, fine = chirps.time_axis(*limits), chirps.time_axis(*limits, bins_per_line=8)
    edges = axis.edges_opl.reshape(-1, 1, 1)
    lines = [torch.from_numpy(chirps.line_shape.cumulative(edges - x)).diff(dim=0) * light for x in places]
    spectra = torch.stack(lines)[None]  # (1, 2, T, H, W)
    arrivals = torch.cat([transient(fine, x / 2, light) for x in places])[None]

    def single(photons: float) -> sensing.Compose:
        return sensing.Compose([sensing.Speckle(4), sensing.BeatNoise(photons, 4)])

    def receiver(photons: float) -> sensing.CoherentReceiver:
        return sensing.CoherentReceiver(chirps, fine, photons_per_unit=photons, looks=4)

    def speeds(photons: float, seed: int, fields: bool) -> Tensor:
        if not fields:
            return sensing.range_and_speed(single(photons).sample(spectra, generator(seed)), chirps, axis)[1][0]
        camera = receiver(photons)
        drawn = camera.sample(arrivals, generator(seed))
        return sensing.range_and_speed(drawn, chirps, camera.spectrum_axis, bins="samples")[1][0]

    figure, panels = sheet(4, 3.3)
    row, at = 26, 35
    camera = receiver(100.0)
    mean, drawn = camera.expected(arrivals), camera.sample(arrivals, generator(0))
    for k, (name, colour) in enumerate((("up", "tab:blue"), ("down", "tab:orange"))):
        panels[0].plot(camera.spectrum_axis.centers_opl, mean[0, k, :, row, at], color=colour, label=f"{name}, mean")
        panels[0].plot(camera.spectrum_axis.centers_opl, drawn[0, k, :, row, at], ".", color=colour, markersize=4)
    panels[0].set(title="a pixel, 4 looks", xlabel="beat in metres of path", ylabel="photons", yscale="log")
    panels[0].legend(fontsize=8)
    colours = {"cmap": "RdBu", "vmin": -2.2, "vmax": 2.2, "interpolation": "nearest"}
    for panel, (name, image) in zip(
        panels[1:3], {"speed, true": speed, "100 photons": speeds(100.0, 0, True)}.items(), strict=True
    ):
        panel.imshow(image, **colours)
        panel.set(title=name, xticks=[], yticks=[])
    photons = [10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0, 10000.0]
    for label, fields in (("fields", True), ("bins for themselves", False)):
        errors = [float((speeds(n, 1, fields) - speed).abs().quantile(0.68)) for n in photons]
        panels[3].loglog(photons, errors, "o-", label=label)
        print(f"{label}: {[round(1e3 * e, 1) for e in errors]} mm/s")
    panels[3].set(title="error of 68 % of pixels, m/s", xlabel="photons of a pixel in a chirp")
    panels[3].legend(fontsize=8)
    save(figure, "beats.png")


PARTS: dict[str, Callable[[], None]] = {
    f.__name__: f
    for f in (
        responses, order_of_effects, pile_up, dead_time, after_detection, macro_pixels, itof_codes, itof_depth,
        itof_pixels, electronics, depth_estimators, gates, streak, polarization, beats,
    )
}  # fmt: skip


def main(parts: list[str]) -> None:
    for name in parts or PARTS:
        PARTS[name]()
        print(f"{name}: {OUT}")


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main(sys.argv[1:])

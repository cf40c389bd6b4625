"""Draw the chains of docs/sensors.md: `python docs/make_chain_figures.py [DEVICE ...]`, a minute on two cores.

One row of a device: the light of one scene pixel, and what there is behind every stage. Blue lines are means, orange
dots one draw; grey is what the stage was given, in the units of what it gives.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor, nn

import torchtransient as tt
from torchtransient import sensing
from torchtransient.sensing import RandomSensor, Sensor

OUT = Path(__file__).parent / "images" / "chains"
NS = 1e9
# what a stage does, and what it gives
CAPTIONS = {
    "ImpulseResponse": "the laser pulse spreads light",
    "LensBlur": "optics spread over pixels",
    "PhotonBudget": "detections per cycle;\nambient and dark counts",
    "SynchronousSPAD": "counts; the first photon\nblocks those behind it",
    "FreeRunningSPAD": "counts; dead times run\non into the next period",
    "MacroPixel": "counts of 100 SPADs;\neach dead after its own",
    "BinaryFrames": "counts; a frame says\nwhether any photon came",
    "GatedIntegration": "photons behind each gate",
    "DetectionJitter": "every detection moves",
    "Afterpulsing": "carriers fire it again later",
    "Crosstalk": "neighbours fire it",
    "TDC": "codes of unequal width",
    "ItofCorrelation": "electrons of each tap",
    "TapDifference": "A - B of each exposure",
    "PixelElectronics": "noise, full well, numbers",
    "PolarizationMosaic": "one analyser per pixel",
    "SweepJitter": "sweeps start early or late",
}
DEAD_TIME = "counts; dead for a while\nafter each of them"
# stages of a device that are not what their kind mostly is
OWN_CAPTIONS = {
    "streak_2ps_like": [
        "optics and tube, over pixels", "optics and tube, over time", "sweeps start early or late",
        "photocathode and gain:\nelectrons are drawn", "phosphor, over pixels", "camera: read noise",
    ],
}  # fmt: skip
# detections of laser light per cycle, or what else the device takes
LEVELS = {
    "kinect_v2_like": 1.0, "streak_2ps_like": 20_000.0, "spad512s_like": 0.02, "vl53l8_like": 40.0,
    "tmf882x_like": 40.0,
}  # fmt: skip


def arrivals(bins: int) -> Tensor:
    """(T,) of sum 1: a surface, a fainter one behind it, and light that went by other walls."""
    shape = torch.zeros(bins, dtype=torch.float64)
    time = torch.arange(bins, dtype=torch.float64) / bins
    late = time >= 0.32
    shape[late] = 0.25 * torch.exp(-(time[late] - 0.32) / 0.06)
    shape *= 0.25 / shape.sum()
    shape[round(0.3 * bins)] += 0.6
    shape[round(0.45 * bins)] += 0.15
    return shape


def light_of(name: str, sensor: nn.Module, axis: tt.TimeAxis | None) -> Tensor:
    """The same light for 3 x 3 pixels, (1, T, 3, 3), in what the device takes."""
    if axis is None:
        stokes = torch.tensor([4000.0, 1800.0, 900.0, 0.0], dtype=torch.float64)
        return stokes.view(4, 1, 1, 1, 1).expand(4, 1, 1, 4, 4)
    shape = LEVELS.get(name, 1.5) * arrivals(axis.num_bins).view(1, -1, 1, 1).expand(1, -1, 3, 3)
    budgets = [s for s in sensor.modules() if isinstance(s, sensing.PhotonBudget)]
    if budgets:
        return shape / float(budgets[0].signal(torch.ones(1, 1, 1, 1, dtype=torch.float64)).sum())
    # counters take rates that have their background already
    return shape + 0.2 / axis.num_bins if "harp" in name else shape


def of_steps(stage: nn.Module, label: str) -> str:
    """What stands where time was, behind a stage."""
    if isinstance(stage, sensing.ItofCorrelation):
        return "tap"
    return "exposure" if isinstance(stage, sensing.TapDifference) else label


def stages_of(sensor: nn.Module) -> Iterator[nn.Module]:
    for stage in sensor.children() if not isinstance(sensor, sensing.Compose) else sensor.stages:
        inner = isinstance(stage, sensing.Compose)
        yield from stages_of(stage) if inner else iter([stage])


def draw_panel(
    axes: Axes,
    mean: Tensor,
    drawn: Tensor | None,
    before: Tensor | None,
    axis: tt.TimeAxis | None,
    label: str,
    has_floor: bool = False,
) -> None:
    """One pixel behind one stage. `has_floor`: there is constant light, which the axis then goes down to."""
    bins = mean.numel()
    axes.tick_params(labelsize=7)
    if bins <= 20:
        axes.bar(range(bins), mean.tolist(), color="tab:blue", alpha=0.4)
        if drawn is not None:
            axes.plot(range(bins), drawn.tolist(), ".", color="tab:orange")
        axes.set_xlabel(label, fontsize=8)
        return
    timed = axis is not None and bins == axis.num_bins
    where = (axis.centers_s * NS).tolist() if timed and axis is not None else range(bins)
    if before is not None:
        axes.plot(where, before.tolist(), lw=0.8, color="0.6", drawstyle="steps-mid")
    if drawn is not None:
        axes.plot(where, drawn.tolist(), ".", ms=2.5, color="tab:orange")
    axes.plot(where, mean.tolist(), lw=1.0, drawstyle="steps-mid")
    shown = mean if before is None else torch.stack([mean, before]).amax(0)
    top = float(shown.max())
    axes.set_yscale("log")
    least = 1e-9 if has_floor else 3e-5 if bins > 400 else 1e-6
    low = float(mean.min())
    if has_floor and before is not None and 0 < float(before.min()) < low < 100 * float(before.min()):
        low = float(before.min())
    axes.set_ylim(max(low / 3, least * top), 3 * top)
    if timed and bins > 400:  # where something happens, so that bins can be seen
        axes.set_xlim(where[round(0.26 * bins)], where[round(0.52 * bins)])
    axes.set_xlabel("ns" if timed else "gate", fontsize=8)


def given(stage: Sensor, mean: Tensor) -> Tensor | None:
    """What a stage was given, in the units of what it gives; None where these have other bins."""
    if isinstance(stage, sensing.PhotonBudget):
        return stage.signal(mean)
    if isinstance(stage, sensing.BinaryFrames):
        return mean * stage.frames
    if stage.takes == ("rate",):
        return mean * next(part.cycles for part in stage.modules() if isinstance(part, sensing.SynchronousSPAD))
    return None if isinstance(stage, (sensing.GatedIntegration, sensing.ItofCorrelation)) else mean


def device_row(name: str) -> Figure:
    device = sensing.device(name)
    axis = device.axis() if device.num_bins else None
    sensor = device.sensor()
    mean = light_of(name, sensor, axis)
    takes = device.description.split("Takes ")[-1].split(",")[0].split(".")[0].replace("the expected ", "")
    takes = "radiance" if "radiance" in takes else takes
    panels: list[tuple[str, str, Tensor, Tensor | None, Tensor | None, str]]
    panels = [("light", takes, pixel(mean), None, None, "S0 to S3")]
    label = "pixel" if axis is None else "gate"
    drawn, is_drawn, random = mean, False, torch.Generator().manual_seed(0)
    for number, stage in enumerate(stages_of(sensor)):
        assert isinstance(stage, Sensor)
        before, mean = given(stage, mean), stage.expected(mean)
        drawn = stage.sample(drawn, random) if isinstance(stage, RandomSensor) else stage.expected(drawn)
        is_drawn = is_drawn or isinstance(stage, RandomSensor)
        kind = type(stage).__name__
        grey = None if before is None or before.shape != mean.shape else pixel(before)
        label = of_steps(stage, label)
        own = getattr(stage, "dead_time_s", None) is not None and kind == "SynchronousSPAD"
        caption = DEAD_TIME if own else CAPTIONS[kind]
        caption = OWN_CAPTIONS[name][number] if name in OWN_CAPTIONS else caption
        panels.append((kind, caption, pixel(mean), pixel(drawn) if is_drawn else None, grey, label))
    figure, has_floor = Figure(figsize=(2.35 * len(panels), 2.6), layout="constrained"), False
    for axes, (title, caption, *values) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        of_mean, of_draw, grey, label = values
        has_floor = has_floor or title == "PhotonBudget"
        draw_panel(axes, of_mean, of_draw, grey, axis, label, has_floor)
        axes.set_title(f"{title}\n\n", fontsize=10, fontweight="bold")
        axes.text(0.5, 1.03, caption, transform=axes.transAxes, ha="center", va="bottom", fontsize=7.5)
    return figure


def pixel(values: Tensor) -> Tensor:
    """What is drawn of (..., C, T, H, W): the middle pixel, or all of a picture without time."""
    if values.shape[-3] == 1:
        return values.flatten() if values.numel() <= 20 else values.flatten(-2)[..., 0].flatten()
    return values[..., values.shape[-2] // 2, values.shape[-1] // 2].flatten()


def main(names: list[str]) -> None:
    OUT.mkdir(parents=True, exist_ok=True)
    for name in names or sorted(sensing.DEVICES):
        device_row(name).savefig(OUT / f"{name}.png", dpi=80)


if __name__ == "__main__":
    main(sys.argv[1:])

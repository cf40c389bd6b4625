"""Draw and write the gallery of docs/accuracy.md: curves with bands and Pareto fronts of seven scenes.

    python docs/make_accuracy_gallery.py [--only NAME,...] [--archive staircase_ccby.tar.gz]

Some minutes on two cores. The staircase (The Wooden Staircase by Wig42, CC-BY 3.0) needs its archive, and is kept as it
is on the page without it. Numbers go to benchmarks/results/accuracy_gallery.
"""

from __future__ import annotations

import argparse
import math
import re
import tarfile
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

import torchtransient as tt
from torchtransient import sensing
from torchtransient.accuracy import AccuracyReport
from torchtransient.errors import ArgumentError
from torchtransient.scenes import transforms
from torchtransient.vis.files import to_palette

HERE = Path(__file__).parent
PAGE, PICTURES = HERE / "accuracy.md", HERE / "images" / "accuracy"
NUMBERS = HERE.parent / "benchmarks" / "results" / "accuracy_gallery"
SceneDict = dict[str, Any]
VARIANT = "llvm_ad_mono"


def peak_distance(out: tt.RenderOutput) -> torch.Tensor:
    """Metres to the brightest moment of each pixel."""
    return sensing.distance_of_position(sensing.peak_position(out.transient), out.axis)


def phase_at(frequency: float) -> Callable[[tt.RenderOutput], torch.Tensor]:
    """The phase of each pixel at a frequency in cycles per metre, as a complex number of magnitude one."""

    def phase(out: tt.RenderOutput) -> torch.Tensor:
        turns = frequency * (out.axis.centers_opl.float() - out.axis.start_opl)
        wave = torch.exp(-2j * math.pi * turns)[:, None, None]
        found = (out.transient * wave).sum(-3)
        return found / found.abs().clamp(min=1e-20)

    return phase


def cornell(resolution: int = 32, **settings: Any) -> SceneDict:
    """The Cornell box, 6 m in bins of 5 cm."""
    return tt.scenes.cornell_box(resolution, **({"num_bins": 120, "bin_width_opl": 0.05} | settings))


def renderer(scene: Any, **settings: Any) -> tt.TransientRenderer:
    return tt.TransientRenderer(tt.load(scene, VARIANT), physics="ignore", **settings)


def light_after(length: float) -> Callable[[tt.RenderOutput], torch.Tensor]:
    """The light of each pixel that arrives after a path of so many metres."""

    def late(out: tt.RenderOutput) -> torch.Tensor:
        return out.transient[..., out.axis.centers_opl > length, :, :].sum(-3)

    return late


def of_values() -> AccuracyReport:
    return tt.cost_of_accuracy(
        renderer(cornell()), (16, 64, 256), max_depths=(3, 8), bin_widths=(0.05, 0.1), progress=False,
        quantities={"light after 7 m": light_after(7.0), "distance of the peak": peak_distance},
    )  # fmt: skip


def of_gradients() -> AccuracyReport:
    key = "red.reflectance.value"
    return tt.cost_of_accuracy(
        renderer(cornell(16), parameters=[key]), (16, 64, 256), [key], repeats=12, max_depths=(4, 8), progress=False
    )


def of_staircase(archive: Path) -> AccuracyReport:
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(archive) as tar:
            tar.extractall(folder, filter="data")
        (path,) = Path(folder).rglob("scene.xml")
        scene = tt.load(path, VARIANT, resx="24", resy="42", max_depth="12", spp="16")
        return tt.cost_of_accuracy(
            renderer(scene, time_axis=tt.TimeAxis(0.0, 0.25, 64)), (16, 64, 256), samplers=("owen",),
            max_depths=(3, 12), integrators=("transient_path", "transient_path_reuse"),
            quantities={"light after 9 m": light_after(9.0)}, progress=False,
        )  # fmt: skip


def of_letter() -> AccuracyReport:
    scan = tt.nlos.Scan.grid(tt.nlos.Wall.plane(2.0, 2.0, albedo=0.7), 16, kind="confocal")
    hidden = tt.scenes.nlos_z()
    axis = scan.default_axis(tt.scenes.bounds(hidden), 0.02)
    return tt.cost_of_accuracy(
        renderer(tt.nlos.capture_scene(hidden, scan), time_axis=axis), (256, 1024, 4096, 16384), samplers=("owen",),
        quantities={"phase at 2 cycles per metre": phase_at(2.0)}, temporal_filters=("box", "tent"),
        bin_widths=(0.02, 0.04, 0.08), progress=False,
    )  # fmt: skip


def of_fog() -> AccuracyReport:
    scene = cornell(24)
    medium = {"type": "homogeneous", "sigma_t": 0.3, "albedo": 0.9, "phase": {"type": "hg", "g": 0.3}}
    scene["fog"] = {"type": "cube", "to_world": transforms.scale(0.999), "bsdf": {"type": "null"}, "interior": medium}
    scene["integrator"] = {**scene["integrator"], "type": "transient_prbvolpath"}
    late = {"light after 7 m": light_after(7.0)}
    return tt.cost_of_accuracy(
        renderer(scene), (16, 64, 256), max_depths=(4, 8, 16), quantities=late, progress=False,
    )  # fmt: skip


def of_caustic() -> AccuracyReport:
    scene = cornell(24, glass=True)
    lamp = transforms.translate([0, 0.99, 0.01]) @ transforms.rotate([1, 0, 0], 90) @ transforms.scale(0.06)
    scene["light"] = {**scene["light"], "to_world": lamp}
    return tt.cost_of_accuracy(
        renderer(scene), (16, 64, 256, 1024), max_depths=(4, 16), quantities={"steady picture": lambda out: out.steady},
        progress=False,
    )  # fmt: skip


def of_gates() -> AccuracyReport:
    gates = [tt.Gate.rectangular(4.0 + k, 5.5 + k) for k in range(4)]

    def mean_gate(out: tt.RenderOutput) -> torch.Tensor:
        shares = out.gated / out.gated.sum(-3, keepdim=True).clamp(min=1e-20)
        return (shares * torch.arange(4.0)[:, None, None]).sum(-3)

    return tt.cost_of_accuracy(
        renderer(cornell(), gates=gates), (4, 16, 64, 256), quantities={"mean gate": mean_gate}, max_depths=(2, 3, 8),
        progress=False,
    )  # fmt: skip


def percent(report: AccuracyReport, quantity: str, setting: str, *, noise: bool = False) -> str:
    """Bias, or noise, of the most samples of the first curve whose name contains a setting."""
    found = next(curve for name, choice, curve in report.curves() if name == quantity and setting in str(choice))
    return f"{found[-1].relative_error if noise else found[-1].bias:.1%}".replace("%", " %")


@dataclass(frozen=True)
class Picture:
    """One picture: how it is made, what it tells, and the errors that settings are recommended for."""

    title: str
    scene: str
    make: Callable[..., AccuracyReport]
    tells: Callable[[AccuracyReport], str]
    targets: dict[str, float]


RED, PEAK, PHASE = "d loss / d red.reflectance.value", "distance of the peak", "phase at 2 cycles per metre"
GALLERY = {
    "cornell": Picture(
        "The Cornell box", "32 x 32 pixels, 6 m of path.", of_values,
        lambda report: "`owen` falls almost twice as steeply where direct light decides. A depth of 3 does for the "
        f"transient, and its light after 7 m is off by {percent(report, 'light after 7 m', 'depth 3')}; bins of 10 cm "
        f"blur the transient by {percent(report, 'transient', 'bins of 0.1 m')}, which no samples lower, and "
        "serve sums and the place of the peak as well as narrow ones.",
        {"transient": 0.1, "light after 7 m": 0.1, PEAK: 0.05},
    ),
    "gradient": Picture(
        "A gradient", "Cornell box, 16 x 16 pixels, by the colour of the red wall; 12 repeats.", of_gradients,
        lambda report: f"A depth of 4 leaves out {percent(report, RED, 'depth 4')} of the derivative, far more than "
        "its noise. The samplers, a factor of ten apart in the transient, can hardly be told apart: bands overlap.",
        {RED: 0.05},
    ),
    "staircase": Picture(
        "The Wooden Staircase", "24 x 42 pixels, 64 bins of 25 cm, `owen`.", of_staircase,
        lambda report: "Rare bright paths make the noise, which falls as that of independent samples. A depth of 3 "
        f"does for the transient, and its light after 9 m is off by {percent(report, 'light after 9 m', 'depth 3')}. "
        "Pixels that share light have less noise in single bins, more in sums over them, and take longer.",
        {"transient": 0.3, "light after 9 m": 0.2},
    ),
    "letter": Picture(
        "A letter around a corner", "The Z of `tt.scenes.nlos_z`, 16 x 16 confocal points, `owen`.", of_letter,
        lambda report: "Wide bins and a tent are less noisy (right) and blur more than that (left): of 4 cm by "
        f"{percent(report, 'transient', 'box, bins of 0.04 m')}, of 8 cm by "
        f"{percent(report, 'transient', 'box, bins of 0.08 m')}. A phase minds less: 4 cm leave "
        f"an error of {percent(report, PHASE, 'box, bins of 0.04 m')}.",
        {"transient": 0.1, PHASE: 0.05},
    ),
    "fog": Picture(
        "Fog", "Cornell box full of thin fog, 24 x 24 pixels.", of_fog,
        lambda report: "A depth of 4 looks best by its noise alone (right), and its light after 7 m is off by "
        f"{percent(report, 'light after 7 m', 'depth 4')}. Depths of 8 and 16 cannot be told apart; late light is "
        "noisy with either sampler.",
        {"transient": 0.2, "light after 7 m": 0.3},
    ),
    "caustic": Picture(
        "A caustic", "Cornell box with a box of glass under a lamp of 12 cm, 24 x 24 pixels.", of_caustic,
        lambda report: "Few bright paths through the glass hold the noise, so that four repeats hardly know it: the "
        "bands are wide. `owen` has a tenth of the squared error and less all the same, and a depth of 4 has no bias "
        "beyond the noise.",
        {"transient": 0.1, "steady picture": 0.05},
    ),
    "gates": Picture(
        "Gates", "Cornell box, 32 x 32 pixels, four gates of 1.5 m; the mean gate of a pixel's light.", of_gates,
        lambda report: "Gates are bright and soon known. Their ratios in dark pixels are not, and a depth of 2, which "
        f"serves the gates, leaves a bias of {percent(report, 'mean gate', 'depth 2')} in them.",
        {"gated": 0.1, "mean gate": 0.05},
    ),
}


def section(name: str, report: AccuracyReport) -> str:
    """The part of the page on one picture."""
    picture = GALLERY[name]
    alt = f"{picture.title}: error against seconds and samples"
    lines = [f"### {picture.title}", "", f"{picture.scene} {picture.tells(report)}", ""]
    lines += [f"![{alt}](images/accuracy/{name}.png)", ""]
    for quantity, error in picture.targets.items():
        try:
            found = report.recommend(error, quantity=quantity)
            interval = f"{found.low:.1%} to {found.high:.1%}".replace("%", " %")
            said = f"{found.choice}, {found.spp} samples, {found.seconds:.2g} s; error {interval}"
        except ArgumentError:
            said = "none of these settings"
        lines.append(f"- {quantity}, error of {error:.0%}: {said}".replace(f"{error:.0%}", f"{100 * error:.0f} %"))
    return "\n".join(lines) + "\n"


def write(name: str, text: str) -> None:
    """Put a part between its marks."""
    page = PAGE.read_text(encoding="utf-8")
    marks = f"<!-- gallery {name}:begin -->\n", f"<!-- gallery {name}:end -->"
    pattern = re.compile(re.escape(marks[0]) + ".*?" + re.escape(marks[1]), re.DOTALL)
    PAGE.write_text(pattern.sub(lambda _: marks[0] + text + marks[1], page), encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--only", default=",".join(GALLERY), help="names of pictures, with commas")
    parser.add_argument("--archive", type=Path, help="staircase_ccby.tar.gz")
    parser.add_argument("--from-json", action="store_true", help="draw and write from the kept numbers")
    options = parser.parse_args()
    PICTURES.mkdir(parents=True, exist_ok=True)
    NUMBERS.mkdir(parents=True, exist_ok=True)
    names = [name for name in options.only.split(",") if name != "staircase" or options.archive or options.from_json]
    for name in tqdm(names, unit="picture"):
        numbers = NUMBERS / f"{name}.json"
        if options.from_json:
            report = AccuracyReport.from_json(numbers)
        else:
            report = GALLERY[name].make(*([options.archive] if name == "staircase" else []))
            report.to_json(numbers)
        report.plot(PICTURES / f"{name}.png")
        to_palette(PICTURES / f"{name}.png")
        write(name, section(name, report))
        tqdm.write(f"{name}\n{report.table()}")


if __name__ == "__main__":
    main()

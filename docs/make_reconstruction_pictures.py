"""Draw the pictures of docs/nlos_reconstruction.md: `python docs/make_reconstruction_pictures.py [FOLDER]`, minutes.

`FOLDER` holds measured captures as they were published, each with its licence: `cdt/letter_s.mat`, `letter_t.mat`,
`mannequin.mat`, `resolution_50.mat` (Lindell and Wetzstein 2020, MIT), `keyhole/K` and `keyhole/E` (Metzler, Lindell
and Wetzstein 2020, BSD-3). Without it only the simulated captures are drawn; a kind of
scan in its place draws those of that kind alone.
"""

from __future__ import annotations

import runpy
import sys
import tempfile
import time
from pathlib import Path

import torchtransient as tt
from torchtransient.cli.main import main as torchtransient
from torchtransient.vis.files import figure_type, save_figure

OUT = Path(__file__).parent / "images" / "reconstruction"
# Sides of the scans, metres.
FOAM = {"letter_s": 0.6, "letter_t": 0.7, "mannequin": 0.7, "resolution_50": 0.7}
# One set for all four: 417 bins of 16 ps in threes, the foam's 2.54 cm, planes between the foam's light and the end.
FOAM_OPTIONS = (
    "--record 0 2.0002 --sum-bins 3 --slab 0.0254 --slab-snr 3e3 --target retroreflective "
    "--depths 0.06 0.88 --flip y --threshold 0.35 --quiet"
)
WALL = tt.nlos.Wall.plane(1.0, 1.0, albedo=0.7)
# Hidden letters, facing the wall and turned about a vertical axis through their middle, degrees.
TURNS = (0, 35)
SCANS = {
    "confocal": tt.nlos.Scan.grid(WALL, 48, kind="confocal"),
    "single": tt.nlos.Scan.grid(WALL, 48, kind="single"),
    "exhaustive": tt.nlos.Scan.grid(WALL, 24, kind="exhaustive", laser_grid=4),
}
METHODS = {
    "confocal": ("fk", "lct", "directional-lct", "phasor"),
    "single": ("phasor", "midpoint-fk", "bp"),
    "exhaustive": ("phasor", "midpoint-fk"),
}
OPTIONS = {"lct": {"snr": 30.0}, "directional-lct": {"snr": 30.0}}
DEPTHS = (0.3, 0.9)
BIN_WIDTH, SPP = 0.01, {"confocal": 2**12, "single": 2**12, "exhaustive": 2**10}


def draw_foam(folder: Path) -> None:
    """By the command line, as the page shows it."""
    with tempfile.TemporaryDirectory() as scratch:
        for name, side in FOAM.items():
            volume, picture = Path(scratch) / f"{name}.npz", OUT / f"{name}.png"
            places = ["--wall-size", str(side), "-o", str(volume), "--picture", str(picture)]
            arguments = ["reconstruct", str(folder / "cdt" / f"{name}.mat"), *places, *FOAM_OPTIONS.split()]
            torchtransient(arguments, standalone_mode=False)


def draw_foam_by_method(folder: Path) -> None:
    """The front view of all four by the methods that take them, with the same options."""
    figure = figure_type()(figsize=(7.0, 7.2), layout="constrained")
    panels = figure.subplots(len(FOAM), len(METHODS["confocal"]), squeeze=False)
    for line, (name, side) in zip(panels, FOAM.items(), strict=True):
        capture = tt.nlos.Capture.read(folder / "cdt" / f"{name}.mat", wall_size=side).crop(0.0, 2.0002)
        capture = tt.nlos.without_slab(tt.nlos.sum_bins(capture, 3), 0.0254, 3e3)
        for panel, method in zip(line, METHODS["confocal"], strict=True):
            target = {} if method == "phasor" else {"target": "retroreflective"}
            volume = tt.nlos.reconstruct(capture, method, depths=(0.06, 0.88), progress=False, **target)
            panel.imshow(volume.picture().clamp_min(0).amax(0).numpy(), cmap="gray")
            panel.set(xticks=[], yticks=[], title=method if name == "letter_s" else "")
        line[0].set_ylabel(name, fontsize=9)
    save_figure(figure, OUT / "foam_by_method.png", "make_reconstruction_pictures", dpi=70)


def draw_keyhole(folder: Path) -> None:
    """By the training example, which knows the track and the response."""
    example = runpy.run_path(str(Path(__file__).parents[1] / "training_examples" / "keyhole_letter.py"))
    for letter in "KE":
        with tempfile.TemporaryDirectory() as scratch:
            example["main"]([str(folder / "keyhole" / letter), "--output", scratch])
            (Path(scratch) / "keyhole_letter.png").replace(OUT / f"keyhole_{letter}.png")


def hidden(turn: float) -> tt.scenes.parts.SceneDict:
    """The letter E, 0.6 m high and 0.6 m before the wall."""
    letter = tt.scenes.nlos_letter("E", size=0.6, depth=0.6)
    moves = tt.scenes.transforms
    there, back = moves.translate([0.0, 0.0, 0.6]), moves.translate([0.0, 0.0, -0.6])
    letter["letter"]["to_world"] = there @ moves.rotate([0, 1, 0], turn) @ back
    return letter


def through_a_file(capture: tt.nlos.Capture) -> tt.nlos.Capture:
    """The capture written and read again, as somebody else would get it."""
    with tempfile.TemporaryDirectory() as scratch:
        return tt.nlos.Capture.read(capture.write(Path(scratch) / "capture.h5"))


def draw_simulated(kind: str) -> None:
    """The front view of the same letters by every method that takes the scan."""
    rows = []
    for turn in TURNS:
        simulated = tt.nlos.simulate(
            hidden(turn), SCANS[kind], time_axis=tt.TimeAxis(0.0, BIN_WIDTH, 256), spp=SPP[kind],
            variant="llvm_ad_mono", progress=False,
        )  # fmt: skip
        capture, volumes = through_a_file(simulated), {}
        for method in METHODS[kind]:
            began = time.perf_counter()
            settings = {"depths": DEPTHS, "progress": False, **OPTIONS.get(method, {})}
            volumes[method] = tt.nlos.reconstruct(capture, method, **settings)
            seconds = time.perf_counter() - began
            print(f"{kind}, turned by {turn} degrees, {method}: {seconds:.1f} s", flush=True)
        rows.append(volumes)
    figure = figure_type()(figsize=(1.9 * len(METHODS[kind]), 4.2), layout="constrained")
    panels = figure.subplots(len(TURNS), len(METHODS[kind]), squeeze=False)
    for turn, volumes, line in zip(TURNS, rows, panels, strict=True):
        for panel, (method, volume) in zip(line, volumes.items(), strict=True):
            width, height = volume.grid.extent
            front = volume.picture().clamp_min(0).amax(0)
            box = (-width / 2, width / 2, -height / 2, height / 2)
            panel.imshow(front.numpy(), cmap="gray", origin="lower", extent=box)
            panel.set(xlim=(-0.5, 0.5), ylim=(-0.5, 0.5), xticks=[], yticks=[], facecolor="black")
            panel.set_title(method if turn == 0 else "", fontsize=9)
        line[0].set_ylabel("facing the wall" if turn == 0 else f"turned by {turn}°", fontsize=9)
    save_figure(figure, OUT / f"{kind}.png", "make_reconstruction_pictures", dpi=80)


def main(given: str | None) -> None:
    """All of them, or those of one kind of scan."""
    OUT.mkdir(parents=True, exist_ok=True)
    if given is not None and given not in SCANS:
        draw_foam(Path(given))
        draw_foam_by_method(Path(given))
        draw_keyhole(Path(given))
    for kind in [given] if given in SCANS else SCANS:
        draw_simulated(kind)
    for path in sorted(OUT.iterdir()):
        print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else None)

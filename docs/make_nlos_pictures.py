"""Simulate and draw the captures of docs/nlos.md: `python docs/make_nlos_pictures.py [SCENE ...]`, a minute.

Each scene is a confocal scan of a wall of 2 x 2 m (of the room: a part of its front), light of three bounces.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

import torchtransient as tt
from torchtransient.vis.files import save_image

OUT = Path(__file__).parent / "images" / "nlos"
# Hidden shapes, size of the wall (m), sensor points, samples for each.
SCENES = {
    "z": (tt.scenes.nlos_z(), (2.0, 2.0), (64, 64), 2**12),
    "letter": (tt.scenes.nlos_letter("K", thickness=0.1), (2.0, 2.0), (64, 64), 2**12),
    "mannequin": (tt.scenes.nlos_mannequin(), (2.0, 2.0), (64, 64), 2**12),
    "room": (tt.scenes.nlos_room(), (2.0, 1.6), (50, 40), 2**15),
}
BIN_WIDTH = 0.02
FRAMES = 6


def frames_row(capture: tt.nlos.Capture) -> np.ndarray:
    """A few bins of the wall side by side, evenly over the time in which most of the light arrives."""
    light = capture.transient.sum((0, 2, 3)).cumsum(0)
    share = light / light[-1]
    first, last = int((share > 0.02).nonzero()[0]), int((share > 0.9).nonzero()[0])
    shown = tt.vis.frames(capture, scale=3)
    chosen = [shown[int(k)] for k in np.linspace(first, last, FRAMES)]
    gap = np.full((chosen[0].shape[0], 4, 3), 255, np.uint8)
    return np.concatenate([part for frame in chosen for part in (frame, gap)][:-1], axis=1)


def main(names: list[str]) -> None:
    """Draw some scenes, all of them by default."""
    OUT.mkdir(parents=True, exist_ok=True)
    for name in names or SCENES:
        hidden, size, points, spp = SCENES[name]
        scan = tt.nlos.Scan.grid(tt.nlos.Wall.plane(*size, albedo=0.7), points, kind="confocal")
        axis = scan.default_axis(tt.scenes.bounds(hidden), BIN_WIDTH)
        began = time.perf_counter()
        capture = tt.nlos.simulate(hidden, scan, time_axis=axis, spp=spp, variant="llvm_ad_mono", progress=False)
        print(f"{name}: {capture}, {time.perf_counter() - began:.1f} s, {capture.metadata['light']}", flush=True)
        figures = {
            "layout": tt.vis.scan_layout(scan, hidden=hidden, title=f"nlos_{name}"),
            "transients": tt.vis.transients_grid(capture, rows=4, columns=4),
            "peak": tt.vis.peak_time_picture(capture),
        }
        for kind, figure in figures.items():
            figure.savefig(OUT / f"{name}_{kind}.png", dpi=60)
        save_image(frames_row(capture), OUT / f"{name}_frames.png", "make_nlos_pictures")
    sizes = {path.name: path.stat().st_size for path in sorted(OUT.iterdir())}
    print(*(f"{name}: {size / 1e3:.0f} kB" for name, size in sizes.items()), sep="\n")


if __name__ == "__main__":
    main(sys.argv[1:])

"""Which method sees a confocal letter best, by the light of a point and the background beside it.

A scan of 32 x 32 points, a wall of one metre, 256 bins of 1 cm, letters that face the wall: an E of 0.6 m, 0.6 m away,
and an S of 0.5 m, 0.4 m away. Counts are Poisson's, of so many photons a point, with a background that is the same in
every bin and of so many photons for each of these. Pearson's correlation of the front view with the letter, as in
`nlos_reconstruction_cost.py`, with the options of `tt.nlos.reconstruct`.
"""

from __future__ import annotations

import json
from pathlib import Path

import torch
from _runner import arguments, environment
from nlos_reconstruction_cost import correlation, filled

import torchtransient as tt
from torchtransient.nlos import VoxelGrid
from torchtransient.nlos.methods import default_wavelength

RESULTS = Path(__file__).parent / "results" / "nlos_background.json"
LETTERS = {"E": (0.6, 0.6), "S": (0.5, 0.4)}
PHOTONS, BACKGROUND = (10, 50, 300, 3000), (0.0, 0.1, 1.0, 3.0)
WINDOW = 0.3


def main() -> None:
    parser = arguments(__doc__, peer=False)
    parser.set_defaults(variant="llvm_ad_mono")
    options = parser.parse_args()
    torch.set_num_threads(1)
    size, spp = (16, 64) if options.quick else (32, 2048)
    scan = tt.nlos.Scan.grid(tt.nlos.Wall.plane(1.0, 1.0, albedo=0.7), size, kind="confocal")
    axis = tt.TimeAxis(0.0, 0.01, 256)
    rows = []
    print("| letter | photons a point | background | fk | lct | phasor |\n|---|---|---|---|---|---|")
    for letter, (height, depth) in LETTERS.items():
        hidden = tt.scenes.nlos_letter(letter, size=height, depth=depth)
        capture = tt.nlos.simulate(
            hidden, scan, time_axis=axis, spp=spp, variant=options.variant, progress=False
        )  # fmt: skip
        light, depths = capture.transient[0], axis.centers_opl / 2
        seen = (depths - depth).abs() < WINDOW
        planes = VoxelGrid.before(scan, depths[seen][::2])
        mesh = hidden["letter"]
        truth = filled(torch.as_tensor(mesh["vertices"], dtype=torch.float64)[torch.as_tensor(mesh["faces"])], planes)
        pulse = tt.nlos.PhasorFilter(default_wavelength(capture), 4.0)
        operators = {
            "fk": tt.nlos.FK(scan, time_axis=axis), "lct": tt.nlos.LCT(scan, time_axis=axis),
            "phasor": tt.nlos.PhasorField(scan, planes, pulse=pulse, time_axis=axis),
        }  # fmt: skip
        for photons in PHOTONS:
            for background in BACKGROUND:
                mean = light * (photons * size**2 / light.sum()) + background * photons / axis.num_bins
                counts = torch.poisson(mean, generator=torch.Generator().manual_seed(0))
                found = {}
                for name, operator in operators.items():
                    volume = operator.reconstruct(counts)
                    volume = volume if name == "phasor" else volume[seen]
                    found[name] = correlation(volume.double(), truth)
                rows.append({"letter": letter, "photons": photons, "background": background, "correlation": found})
                shown = " | ".join(f"{value:.2f}" for value in found.values())
                print(f"| {letter} | {photons} | {background:g} | {shown} |", flush=True)
    path = options.json or (None if options.quick else RESULTS)
    if path is not None:
        data = {"rows": rows, "environment": environment(options.variant)}
        path.write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

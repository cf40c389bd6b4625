"""What accuracy costs around a corner: error of a capture against seconds, by estimator.

Light of three bounces from hidden samples that all scan points share, from paths that draw points over the hidden area,
and from paths that follow the BSDFs alone; the three have one mean. Writes the picture of docs/nlos.md and the numbers
next to it.
"""

from __future__ import annotations

import json

from _runner import curve_arguments, output

import torchtransient as tt
from torchtransient.vis.accuracy_curve import Curve, plot_accuracy

ESTIMATORS = {
    "shared samples": {},
    "paths, hidden area": {"third_bounce": "paths"},
    "paths, BSDF alone": {"third_bounce": "paths", "nlos_hidden_geometry_sampling": False},
}
# Hidden shapes and the size of the wall, metres.
HIDDEN = {
    "letter Z": (tt.scenes.nlos_z, (2.0, 2.0)),
    "mannequin": (tt.scenes.nlos_mannequin, (2.0, 2.0)),
    "room": (tt.scenes.nlos_room, (2.0, 1.6)),
}


def main() -> None:
    picture, numbers_file = "docs/images/nlos/accuracy.png", "benchmarks/results/nlos_accuracy.json"
    parser = curve_arguments(__doc__, picture, numbers_file, repeats=4)
    parser.add_argument("--points", type=int, default=32)
    options = parser.parse_args()
    options.picture = output(options.picture, picture, quick=options.quick)
    options.json = output(options.json, numbers_file, quick=options.quick)
    points, spp = (2, (4, 16)) if options.quick else (options.points, (256, 1024, 4096, 16384))
    curves, numbers = [], {}
    for name, (hidden, size) in HIDDEN.items():
        scan = tt.nlos.Scan.grid(tt.nlos.Wall.plane(*size, albedo=0.7), points, kind="confocal")
        shapes = hidden()
        axis = scan.default_axis(tt.scenes.bounds(shapes), 0.02)
        for label, settings in ESTIMATORS.items():
            scene = tt.nlos.capture_scene(shapes, scan)
            scene["integrator"] |= settings
            renderer = tt.TransientRenderer(tt.load(scene, "llvm_ad_mono"), time_axis=axis)
            report = tt.cost_of_accuracy(
                renderer, spp=spp, repeats=options.repeats, samplers=("independent",), progress=False
            )
            found = report.points
            curves.append(
                Curve(
                    quantity=f"{name}, {points} x {points} points, {axis.num_bins} bins",
                    label=label,
                    spp=[p.spp for p in found],
                    seconds=[p.seconds for p in found],
                    squared_relative_error=[p.relative_error**2 for p in found],
                )
            )
            numbers.setdefault(name, {})[label] = [
                {"spp": p.spp, "seconds": p.seconds, "squared_relative_error": p.relative_error**2} for p in found
            ]
            last = found[-1]
            print(f"{name:12} {label:20} {last.spp} spp {last.seconds:.3f} s, error {last.relative_error:.2%}")
    options.picture.parent.mkdir(parents=True, exist_ok=True)
    plot_accuracy(curves, options.picture)
    options.json.write_text(json.dumps({"points": points, "curves": numbers}, indent=2) + "\n", encoding="utf-8")
    for name, of in numbers.items():
        costs = {label: rows[-1]["seconds"] * rows[-1]["squared_relative_error"] for label, rows in of.items()}
        gains = ", ".join(f"{label} {costs[label] / costs['shared samples']:.1f}" for label in list(of)[1:])
        print(f"{name}: time to an error over that of shared samples: {gains}")


if __name__ == "__main__":
    main()

"""What accuracy costs in time: error of the Cornell box's transient and gradients, for the curve of docs/accuracy.md.

Writes the picture and the numbers next to it. The choices compared are the sampler and the temporal filter.
"""

from __future__ import annotations

from _runner import curve_arguments, output

import torchtransient as tt
from torchtransient.vis.files import to_palette


def main() -> None:
    picture, numbers = "docs/images/accuracy_cornell.png", "benchmarks/results/accuracy_cornell.json"
    parser = curve_arguments(__doc__, picture, numbers, repeats=12)
    parser.add_argument("--resolution", type=int, default=64)
    options = parser.parse_args()
    resolution, spp = (8, (4, 16)) if options.quick else (options.resolution, (16, 64, 256))

    keys = ["red.reflectance.value", "light.emitter.radiance.value"]
    box = tt.scenes.cornell_box(resolution=resolution, num_bins=300, spp=64)
    renderer = tt.TransientRenderer(tt.load(box, variant="llvm_ad_rgb"), parameters=keys, spp=64)
    report = tt.cost_of_accuracy(
        renderer,
        spp=spp,
        gradients=keys,
        repeats=options.repeats,
        samplers=("independent", "owen", "multijitter"),
        temporal_filters=("box", "tent"),
    )
    print(report.table())
    options.picture = output(options.picture, picture, quick=options.quick)
    options.json = output(options.json, numbers, quick=options.quick)
    report.to_json(options.json)
    report.plot(options.picture)
    to_palette(options.picture)
    print(f"picture: {options.picture}, numbers: {options.json}")


if __name__ == "__main__":
    main()

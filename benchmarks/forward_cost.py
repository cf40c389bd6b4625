"""Forward: `transient_path` against Mitsuba's steady `path` and `prb`, and mitransient against its own `path`.

Cornell box, 256 x 256, 64 spp, depth 8, 300 and 2048 bins. Bars: 1.16 x the steady `path` at 300 bins and 1.26 x at
2048. With `--peer-python` the peer runs between our runs, in its own process and environment, and is compared with its
own `path`.
"""

from __future__ import annotations

from _comparison import OURS, PEER, Comparison, Row, comparison_arguments
from _runner import steady

from torchtransient.scenes import cornell_box

BARS = {300: 1.16, 2048: 1.26}


def rows(scenes: dict[int, dict]) -> list[Row]:
    """The transient scenes, and the first of them for Mitsuba's own integrators."""
    first = next(iter(scenes.values()))
    transient = [Row(f"{n} bins", scene, against={"steady path": BARS.get(n)}) for n, scene in scenes.items()]
    prb = Row("steady prb", steady(first, "prb"), against={"steady path": None}, control=True)
    return [*transient, Row("steady path", steady(first, "path"), control=True), prb]


def main() -> None:
    options = comparison_arguments(__doc__).parse_args()
    resolution, spp, bins = (16, 4, (30, 60)) if options.quick else (256, 64, (300, 2048))
    # The window is the same whatever the number of bins.
    scenes = {n: cornell_box(resolution, num_bins=n, bin_width_opl=6.0 / n, spp=spp) for n in bins}
    comparison = Comparison(options, spp)
    for library in (OURS, PEER):
        comparison.add(library, rows(scenes))
    settings = {"resolution": resolution, "spp": spp, "max_depth": 8}
    comparison.run("forward_cost", settings, options.json)


if __name__ == "__main__":
    main()

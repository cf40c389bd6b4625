"""Render and backward: ours with gradients through the time of flight against mitransient without them.

Cornell box, 128 x 128, 64 spp, depth 8, 300 bins. Ours differentiates the red albedo and the position of the red wall
along its normal (tent filter); the peer, whose time of flight has no derivative, the red albedo alone. Our albedo alone
is shown too. Bars: 0.70 x the peer for the albedo, 0.85 x with the wall. Without `--peer-python` only our own cases are
compared with each other.
"""

from __future__ import annotations

from _comparison import OURS, PEER, Comparison, Row, comparison_arguments, with_tent

from torchtransient.scenes import cornell_box

ALBEDO, WALL = "red.reflectance.value", {"red-wall.to_world": [1.0, 0.0, 0.0]}


def main() -> None:
    options = comparison_arguments(__doc__).parse_args()
    resolution, spp, bins = (16, 4, 60) if options.quick else (128, 64, 300)
    box = cornell_box(resolution, num_bins=bins, bin_width_opl=6.0 / bins, spp=spp)
    plain = [Row("render", box), Row("albedo", box, (ALBEDO,), against={"render": None})]
    comparison = Comparison(options, spp)
    comparison.add(OURS, [*plain, Row("albedo and wall", with_tent(box), (ALBEDO,), WALL, {"render": None})])
    comparison.add(PEER, plain)
    comparison.add_ratio("torchtransient: albedo", "mitransient: albedo", 0.70)
    comparison.add_ratio("torchtransient: albedo and wall", "mitransient: albedo", 0.85)
    settings = {"resolution": resolution, "spp": spp, "bins": bins, "max_depth": 8}
    comparison.run("backward_cost", settings, options.json)


if __name__ == "__main__":
    main()

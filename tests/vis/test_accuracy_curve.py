"""Error against time and samples: points, the guide of slope -1, ticks and words."""

from __future__ import annotations

import numpy as np
import PIL.Image
import pytest

from torchtransient.errors import ShapeError
from torchtransient.vis import accuracy_curve
from torchtransient.vis.accuracy_curve import Curve, plot_accuracy

CURVES = [
    Curve("transient", "path", [4, 16, 64], [0.5, 0.0, 3.0], [0.2, 0.1, 0.025]),
    Curve("transient", "guided", [4, 16], [0.7, 2.0], [-1.0, 0.3]),
    Curve("gradient", "path", [8], [1.8], [0.4]),
]


@pytest.fixture
def drawn(monkeypatch):
    """The panels of curves, row by row."""

    def draw(curves):
        kept = []
        monkeypatch.setattr(accuracy_curve, "save_figure", lambda figure, *_, **__: kept.append(figure))
        plot_accuracy(curves, "out.png")
        figure = kept[0]
        return figure, np.array(figure.axes).reshape(-1, 2)

    return draw


def lines(panel):
    return {line.get_label(): (line.get_xdata().tolist(), line.get_ydata().tolist()) for line in panel.lines}


def test_points_are_what_is_above_zero(drawn):
    figure, panels = drawn(CURVES)
    np.testing.assert_allclose(figure.get_size_inches(), [12, 7.6])
    seconds, spp = lines(panels[0, 0]), lines(panels[0, 1])
    assert seconds["path"] == ([0.5, 3.0], [0.2, 0.025]) and seconds["guided"] == ([2.0], [0.3])
    assert spp["path"] == ([4, 16, 64], [0.2, 0.1, 0.025]) and spp["guided"] == ([16], [0.3])
    assert set(lines(panels[1, 0])) == {"path", "slope -1"}
    assert [line.get_marker() for line in panels[0, 0].lines] == ["o", "s", "None"]
    for panel in panels.flat:
        assert panel.get_xscale() == panel.get_yscale() == "log"


def test_the_guide_falls_as_independent_samples_do(drawn):
    _, panels = drawn(CURVES)
    for panel, x, y in (
        (panels[0, 0], [0.5, 3.0], [0.2, 0.1 / 3]),
        (panels[0, 1], [4, 64], [0.2, 0.0125]),
        # Of one point, to twice of what it took.
        (panels[1, 0], [1.8, 3.6], [0.4, 0.2]),
        (panels[1, 1], [8, 16], [0.4, 0.2]),
    ):
        np.testing.assert_allclose(lines(panel)["slope -1"], (x, y))


def test_bands_totals_and_the_front(drawn):
    """Left the error with the bias and the front, right the noise and its slope."""
    curve = Curve(
        "transient", "deep", [4, 16], [1.0, 2.0], [0.4, 0.1], band=[(0.2, 0.8), (0.05, 0.2)], total=[0.5, 0.3],
        total_band=[(0.3, 0.7), (0.2, 0.4)], slope=(-1.02, 0.05), on_front=[False, True],
    )  # fmt: skip
    _, panels = drawn([curve, Curve("transient", "shallow", [4, 16], [0.5, 0.8], [0.2, 0.1], on_front=[True, False])])
    left, right = panels[0]
    assert lines(left)["deep"] == ([1.0, 2.0], [0.5, 0.3])
    assert lines(left)["Pareto front"] == ([0.5, 2.0], [0.2, 0.3]) and "Pareto front" not in lines(right)
    assert lines(right)["deep\nslope \u22121.02 ± 0.05"] == ([4, 16], [0.4, 0.1])
    bars, (band,) = left.collections, (kept.get_paths() for kept in right.collections)
    ends = [path.vertices.tolist() for path in bars[0].get_paths()]
    assert ends == [[[1.0, 0.3], [1.0, 0.7]], [[2.0, 0.2], [2.0, 0.4]]]
    assert {tuple(vertex) for vertex in band[0].vertices} == {(4, 0.2), (4, 0.8), (16, 0.05), (16, 0.2)}
    words = [text.get_text().split("\n")[0] for text in right.get_legend().texts]
    assert words == ["deep", "shallow", "slope -1", "Pareto front"]
    assert [panel.get_title(loc="right") for panel in (left, right)] == ["noise and bias", "noise alone"]


def test_of_many_curves_those_on_the_front_have_colours(drawn):
    curves = [Curve("q", str(k), [4, 16], [1.0 + k, 2.0 + k], [0.4, 0.1], on_front=[k == 7, k == 3]) for k in range(9)]
    _, panels = drawn(curves)
    shown = [text.get_text() for text in panels[0, 1].get_legend().texts]
    assert shown == ["3", "7", "7 others", "slope -1", "Pareto front"]
    colours = {line.get_label(): line.get_color() for line in panels[0, 1].lines}
    assert colours["3"] != colours["7"] and colours["7 others"] == "0.75"
    _, panels = drawn([Curve("q", str(k), [4], [1.0], [0.4]) for k in range(9)])
    assert [t.get_text() for t in panels[0, 1].get_legend().texts] == [*map(str, range(6)), "3 others", "slope -1"]


def test_the_file(tmp_path):
    plot_accuracy(CURVES[2:], tmp_path / "a.png")
    with PIL.Image.open(tmp_path / "a.png") as picture:
        assert picture.size == (1200, 400)
    with pytest.raises(ShapeError, match="at least one curve, got none"):
        plot_accuracy([], tmp_path / "b.png")

"""Distributions of recipes: what they reach, what they are on average, and what fits where."""

from __future__ import annotations

import pickle
from statistics import NormalDist

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.sweeps import together
from torchtransient.data.distributions import ANYTHING, NUMBERS, POSE, Extreme, Fixed, Place, Stream
from torchtransient.data.serialization import read_distribution, written
from torchtransient.errors import SceneError, ShapeError, UnitError

D = tt.data
DRAWS = 400
NUMBER = Place("x", NUMBERS, ())
COLOUR = Place("x", NUMBERS, (3,), np.array([0.1, 0.2, 0.3]))
TURNED = tt.scenes.transforms.rotate([0, 1, 0], 30) @ np.diag([2.0, 1, 1, 1])
T0 = tt.scenes.transforms.translate([1.0, 2.0, 3.0]) @ TURNED
AT = Place("box.to_world", POSE, (4, 4), T0)


def many(distribution, place=NUMBER, count=DRAWS):
    return np.array([distribution.draw(Stream(1, index, "x"), place) for index in range(count)])


def test_ends_are_reached_and_not_left():
    for distribution, low, high in (
        (D.Uniform(-1, 3), -1, 3), (D.LogUniform(0.1, 10), 0.1, 10), (D.Normal(0, 5, low=-1, high=2), -1, 2),
        (D.Uniform(4, 4), 4, 4), (D.Normal(1, 0), 1, 1), (D.LogUniform(1e-300, 1e300), 1e-300, 1e300),
    ):  # fmt: skip
        drawn = many(distribution, count=500)
        assert low <= drawn.min() and drawn.max() <= high
        ends = [float(distribution.draw(Extreme(upper), NUMBER)) for upper in (False, True)]
        assert ends == pytest.approx([low, high], abs=1e-9, rel=1e-9)


def test_entries_are_independent_unless_same():
    drawn = many(D.Uniform([0, 0, 0], [1, 2, 4]), COLOUR, 4000)
    assert np.abs(np.corrcoef(drawn.T) - np.eye(3)).max() < 4 / np.sqrt(4000)
    assert drawn.max(0) == pytest.approx([1, 2, 4], rel=0.01)
    grey = D.Uniform(0, 1, same=True).draw(Stream(0, 0, "x"), COLOUR)
    assert grey.shape == (3,) and (grey == grey[0]).all()


def test_streams_are_of_seed_sample_and_purpose():
    first = Stream(3, 17, "a").random((4,))
    assert np.array_equal(first, Stream(3, 17, "a").random((4,)))
    others = [Stream(4, 17, "a"), Stream(3, 18, "a"), Stream(3, 17, "b"), Stream(31, 7, "a"), Stream(3, 1, "7/a")]
    assert all(not np.array_equal(first, other.random((4,))) for other in others)
    # What is drawn today is drawn tomorrow: data sets are made anew from their recipes.
    assert Stream(0, 0, "red").random() == pytest.approx(0.44664141, abs=1e-7)
    assert Stream(0, 0, "red").seed() == 2565223280


def test_choice_of_weight_zero_never_comes():
    drawn = many(D.Choice([1, 2, 3], weights=[0.3, 0.7, 0.0]), count=3000)
    assert set(drawn) == {1, 2}
    assert D.Choice([1, 2, 3], weights=[0.3, 0.7, 0.0]).draw(Extreme(True), NUMBER) == 2
    assert D.Choice([1, 2], weights=[0, 1]).draw(Extreme(False), NUMBER) == 2


@pytest.mark.parametrize("u", [0.25, 0.75])
def test_numbers_of_one_draw(u):
    """Quantiles: of the logarithm, of what is left of a normal distribution between its ends."""
    normal = NormalDist(3.0, 2.0)
    below, above = normal.cdf(2.0), normal.cdf(7.0)
    for distribution, expected in (
        (D.Uniform(2, 10), 2 + 8 * u),
        (D.LogUniform(2, 32), 2 * 16**u),
        (D.Normal(3, 2), normal.inv_cdf(u)),
        (D.Normal(3, 2, low=2), normal.inv_cdf(below + u * (1 - below))),
        (D.Normal(3, 2, high=7), normal.inv_cdf(u * above)),
        (D.Normal(3, 2, low=2, high=7), normal.inv_cdf(below + u * (above - below))),
    ):
        assert float(distribution.draw(Fixed(u), NUMBER)) == pytest.approx(expected, rel=1e-12)
    assert D.Scale(2, 10).draw(Fixed(u), COLOUR) == pytest.approx((2 + 8 * u) * COLOUR.described)
    assert D.Scale(2, 10).draw(Fixed(u), AT) == pytest.approx(T0 @ np.diag([*[2 + 8 * u] * 3, 1]))
    assert D.Offset(2, 10).draw(Fixed(u), COLOUR) == pytest.approx(COLOUR.described + 2 + 8 * u)
    turned = D.Turn([0, 0, 1], 20, 100).draw(Fixed(u), AT)
    assert turned == pytest.approx(D.Turn([0, 0, 1], 20 + 80 * u, 20 + 80 * u).draw(Fixed(0.0), AT))


def test_ends_of_normal_distributions():
    """An end at infinity is none; a deviation of zero is the mean; a billionth of the distribution has to be left."""
    assert D.Normal(0, 1, low=-np.inf, high=np.inf) == D.Normal(0, 1)
    ends = [float(D.Normal(1, 2).draw(Extreme(upper), NUMBER)) for upper in (False, True)]
    assert np.isfinite(ends).all() and ends[0] + ends[1] == pytest.approx(2)
    for mean in (0.0, 1.0):
        assert float(D.Normal(mean, 0, low=0, high=1).draw(Fixed(0.25), NUMBER)) == mean
    D.Normal(0, 1, low=5.99)
    with pytest.raises(UnitError, match="next to nothing"):
        D.Normal([0, 0], 1, low=6.01)


def test_a_number_that_draws_each_choice():
    """In the middle of its share."""
    weighted, even = D.Choice([1, 2, 3], weights=[1, 2, 5]), D.Choice([1, 2, 3, 4])
    assert [weighted.share(n) for n in range(3)] == [1 / 16, 2 / 8, 11 / 16]
    assert [even.share(n) for n in range(4)] == [1 / 8, 3 / 8, 5 / 8, 7 / 8]
    for one in (weighted, even):
        assert [float(one.draw(Fixed(one.share(n)), NUMBER)) for n in range(len(one.values))] == one.values
    # At the border of two shares the second one begins.
    assert float(weighted.draw(Fixed(1 / 8), NUMBER)) == 2 and float(even.draw(Fixed(0.5), NUMBER)) == 3
    assert float(even.draw(Fixed(np.nextafter(1.0, 0.0)), NUMBER)) == 4


def test_choices_are_copies_in_plain_numbers():
    colour = torch.tensor([1.0, 2.0, 3.0], requires_grad=True)
    array, nested = np.arange(3.0), {"radius": np.float32(0.5), "places": (np.int64(2), [torch.tensor(3)])}
    choice = D.Choice([colour, array, np.float64(4.0), nested, "text"])
    array += 1
    assert choice.values[1].tolist() == [0, 1, 2] and type(choice.values[2]) is float
    assert choice.values[3] == {"radius": 0.5, "places": [2, [3]]} and choice.values[4] == "text"
    assert choice.draw(Fixed(0.5), Place("x", ANYTHING)) == 4.0
    assert written([colour, array]) == [[1, 2, 3], [1, 2, 3]]
    first = D.Choice([colour]).draw(Fixed(0.0), COLOUR)
    assert first.tolist() == [1, 2, 3] and first.dtype == np.float64
    # One number for all entries; what is drawn is its receiver's.
    same = D.Choice([2])
    drawn = same.draw(Fixed(0.0), COLOUR)
    drawn += 1
    assert drawn.tolist() == [3, 3, 3] and same.draw(Fixed(0.0), COLOUR).tolist() == [2, 2, 2]
    assert D.Choice([T0.tolist()]).draw(Fixed(0.0), AT) == pytest.approx(T0)


# --------------------------------------------------------------------------------------------------------------- poses


def test_turns_keep_what_they_turn_about():
    for about, fixed in (("self", T0[:3, 3]), ("world", np.zeros(3)), ([5.0, 0, 1], np.array([5.0, 0, 1]))):
        turn = D.Turn([0, 0, 2], 90, 90, about=about).draw(Stream(0, 0, "x"), AT) @ np.linalg.inv(T0)
        assert turn[:3, :3] == pytest.approx(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), abs=1e-12)
        assert turn[:3, :3] @ fixed + turn[:3, 3] == pytest.approx(fixed)


def test_compose_goes_on_from_where_the_last_one_was():
    steps = [D.Offset([1, 0, 0], [1, 0, 0]), D.Turn([0, 1, 0], 90, 90, about="world")]
    place = Place("x", POSE, (4, 4), np.eye(4))
    assert D.Compose(steps).draw(Fixed(0.0), place)[:3, 3] == pytest.approx([0, 0, -1])
    assert D.Compose(steps[::-1]).draw(Fixed(0.0), place)[:3, 3] == pytest.approx([1, 0, 0])
    moved = D.Offset([1, 2, 3], [1, 2, 3]).draw(Fixed(0.0), AT)
    assert moved[:3, 3] == pytest.approx(T0[:3, 3] + [1, 2, 3]) and np.array_equal(moved[:3, :3], T0[:3, :3])
    # Vertices move together.
    vertices = Place("v", NUMBERS, (5, 3), np.arange(15.0).reshape(5, 3))
    shifted = D.Offset([0, 0, 1], [0, 0, 2]).draw(Stream(0, 0, "x"), vertices) - vertices.described
    assert (shifted == shifted[0]).all() and shifted[0, 0] == 0 and 1 <= shifted[0, 2] <= 2


def test_look_at():
    pose = D.LookAt(D.Uniform([0, 0, 4], [0, 0, 4]), [0, 0, 0]).draw(Stream(0, 0, "x"), AT)
    assert pose == pytest.approx(tt.scenes.transforms.look_at([0, 0, 4], [0, 0, 0]))
    moved = D.LookAt(D.Compose([D.Uniform([0, 0, 4], [0, 0, 4]), D.Offset(0, 0)]), [0, 0, 0])
    assert moved.draw(Stream(0, 0, "x"), AT) == pytest.approx(pose)
    with pytest.raises(SceneError, match="parallel"):
        D.LookAt([0, 4, 0], [0, 0, 0]).draw(Stream(0, 0, "x"), AT)


# ------------------------------------------------------------------------------------------------------- what is wrong

WRONG = {
    "low over high": (lambda: D.Uniform(2, 1), UnitError, "low <= high"),
    "not finite": (lambda: D.Uniform(0, np.inf), UnitError, "finite"),
    "shapes": (lambda: D.Uniform([0, 0], [1, 1, 1]), ShapeError, "one shape"),
    "log of zero": (lambda: D.LogUniform([1, 0], [2, 2]), UnitError, "greater than zero"),
    "negative deviation": (lambda: D.Normal(0, -1), UnitError, "std"),
    "mean outside": (lambda: D.Normal([0, 5], [1, 0], low=0, high=1), UnitError, "next to nothing"),
    "mean below": (lambda: D.Normal(-5, 0, low=0), UnitError, "next to nothing"),
    "empty choice": (lambda: D.Choice([]), SceneError, "at least one"),
    "weights": (lambda: D.Choice([1, 2], weights=[1]), UnitError, "2 weights"),
    "negative weight": (lambda: D.Choice([1, 2], weights=[2, -1]), UnitError, "weights of at least 0"),
    "end that is none": (lambda: D.Normal(0, 1, low=np.nan), UnitError, "low: expected a finite number"),
    "ends in turns": (lambda: D.Normal(0, 1, low=2, high=1), UnitError, "between low=2 and high=1"),
    "two numbers for a point": (lambda: D.LookAt([1, 2], [0, 0, 0]), ShapeError, "three finite numbers"),
    "axis": (lambda: D.Turn([0, 0, 0]), UnitError, "length"),
    "scale": (lambda: D.Scale(-1, 1), UnitError, "at least 0"),
}


@together("wrong", WRONG)
def test_what_is_wrong_says_so(wrong):
    make, error, words = WRONG[wrong]
    with pytest.raises(error, match=words):
        make()


PLACES = {
    "uniform pose": (D.Uniform(0, 1), AT, SceneError, "Turn, Offset"),
    "turned colour": (D.Turn(), COLOUR, SceneError, "for transforms"),
    "shape": (D.Uniform([0, 0], [1, 1]), COLOUR, ShapeError, r"shape \(2,\)"),
    "choice of shape": (D.Choice([[1, 2]]), COLOUR, ShapeError, "choices of shape"),
    "number for a pose": (D.Choice([1.0]), AT, ShapeError, "choices of shape"),
    "composed entry": (
        D.Compose([D.Offset(0, 1)]), Place("box.bsdf", ANYTHING), SceneError, "Compose is for parameters; use Choice"
    ),
    "nothing described": (D.Scale(1, 2), Place("box.bsdf", ANYTHING), SceneError, "no parameter"),
}  # fmt: skip


@together("wrong", PLACES)
def test_what_does_not_fit_says_so(wrong):
    distribution, place, error, words = PLACES[wrong]
    with pytest.raises(error, match=words):
        distribution.draw(Stream(0, 0, "x"), place)


EVERY = [
    D.Uniform(0, [1, 2, 3]), D.LogUniform(1, 2, same=True), D.Normal(0, 1, low=-1), D.Scale(1, 2),
    D.Turn([1, 0, 0], -5, 5), D.Turn(about=[1, 2, 3]),
    D.Offset([0, 0, 0], [1, 1, 1]), D.LookAt([0, 0, 1], D.Uniform([0, 0, 0], [1, 1, 0])),
    D.Compose([D.Turn(), D.Offset(0, 1)]), D.Choice(["a.ply", "b.ply"], weights=[1, 3]),
    D.Choice([{"type": "sphere", "radius": 2.0}, {"type": "cube", "to_world": np.eye(4).tolist()}]),
]  # fmt: skip


@pytest.mark.parametrize("one", EVERY, ids=lambda one: one.name)
def test_written_read_pickled_and_compared(one):
    plain = written(one)
    assert read_distribution("x", plain) == one and written(read_distribution("x", plain)) == plain
    assert pickle.loads(pickle.dumps(one)) == one
    assert sum(one == other for other in EVERY) == 1

"""Distributions of recipes: what they reach, what they are on average, and what fits where."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

import torchtransient as tt
from torchtransient.data.recipes.distribution import ANYTHING, NUMBERS, POSE, Place
from torchtransient.data.recipes.streams import Extreme, Stream
from torchtransient.data.recipes.written import read_distribution, written
from torchtransient.errors import ArgumentError, SceneError, ShapeError, UnitError

D = tt.data
DRAWS = 5000
NUMBER = Place("x", NUMBERS, ())
COLOUR = Place("x", NUMBERS, (3,), np.array([0.1, 0.2, 0.3]))
TURNED = tt.scenes.transforms.rotate([0, 1, 0], 30) @ np.diag([2.0, 1, 1, 1])
T0 = tt.scenes.transforms.translate([1.0, 2.0, 3.0]) @ TURNED
AT = Place("box.to_world", POSE, (4, 4), T0)


def many(distribution, place=NUMBER, count=DRAWS):
    return np.array([distribution.draw(Stream(1, index, "x"), place) for index in range(count)])


@pytest.mark.parametrize(
    "distribution, mean, std",
    [
        (D.Uniform(2, 5), 3.5, 3 / np.sqrt(12)),
        (D.LogUniform(1, np.e), np.e - 1, np.sqrt((np.e**2 - 1) / 2 - (np.e - 1) ** 2)),
        (D.Normal(1, 2), 1, 2),
        # Half of a normal distribution.
        (D.Normal(0, 1, low=0), np.sqrt(2 / np.pi), np.sqrt(1 - 2 / np.pi)),
        (D.Choice([1, 2, 6], weights=[1, 1, 2]), 3.75, np.sqrt((1 + 4 + 2 * 36) / 4 - 3.75**2)),
    ],
    ids=["uniform", "log", "normal", "half normal", "choice"],
)
def test_mean_and_deviation(distribution, mean, std):
    drawn = many(distribution)
    # 4 standard errors; of a deviation some 1 / sqrt(2 n) of itself for these.
    assert abs(drawn.mean() - mean) < 4 * std / np.sqrt(DRAWS)
    assert abs(drawn.std() - std) < 4 * std / np.sqrt(DRAWS)


def test_ends_are_reached_and_not_left():
    for distribution, low, high in (
        (D.Uniform(-1, 3), -1, 3), (D.LogUniform(0.1, 10), 0.1, 10), (D.Normal(0, 5, low=-1, high=2), -1, 2),
        (D.Uniform(4, 4), 4, 4), (D.Normal(1, 0), 1, 1), (D.LogUniform(1e-300, 1e300), 1e-300, 1e300),
    ):  # fmt: skip
        drawn = many(distribution, count=2000)
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


# --------------------------------------------------------------------------------------------------------------- poses


def test_turns_keep_what_they_turn_about():
    for about, fixed in (("self", T0[:3, 3]), ("world", np.zeros(3)), ([5.0, 0, 1], np.array([5.0, 0, 1]))):
        turn = D.Turn([0, 0, 2], 90, 90, about=about).draw(Stream(0, 0, "x"), AT) @ np.linalg.inv(T0)
        assert turn[:3, :3] == pytest.approx(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), abs=1e-12)
        assert turn[:3, :3] @ fixed + turn[:3, 3] == pytest.approx(fixed)


def test_offsets_are_in_the_world():
    moved = D.Offset([1, 2, 3], [1, 2, 3]).draw(Stream(0, 0, "x"), AT)
    assert moved[:3, 3] == pytest.approx(T0[:3, 3] + [1, 2, 3]) and np.array_equal(moved[:3, :3], T0[:3, :3])
    vertices = Place("v", NUMBERS, (5, 3), np.arange(15.0).reshape(5, 3))
    shifted = D.Offset([0, 0, 1], [0, 0, 2]).draw(Stream(0, 0, "x"), vertices) - vertices.described
    assert (shifted == shifted[0]).all() and shifted[0, 0] == 0 and 1 <= shifted[0, 2] <= 2
    brighter = D.Offset(0.5, 0.5).draw(Stream(0, 0, "x"), COLOUR)
    assert brighter == pytest.approx(COLOUR.described + 0.5)


def test_scales():
    assert D.Scale(2, 2).draw(Stream(0, 0, "x"), AT) == pytest.approx(T0 @ np.diag([2, 2, 2, 1]))
    along = D.Scale([1, 2, 3], [1, 2, 3], same=False)
    assert along.draw(Stream(0, 0, "x"), AT) == pytest.approx(T0 @ np.diag([1, 2, 3, 1]))
    assert D.Scale(3, 3).draw(Stream(0, 0, "x"), COLOUR) == pytest.approx(3 * COLOUR.described)


def test_compose_goes_on_from_where_the_last_one_was():
    steps = [D.Offset([1, 0, 0], [1, 0, 0]), D.Turn([0, 1, 0], 90, 90, about="world")]
    place = Place("x", POSE, (4, 4), np.eye(4))
    assert D.Compose(steps).draw(Stream(0, 0, "x"), place)[:3, 3] == pytest.approx([0, 0, -1])
    assert D.Compose(steps[::-1]).draw(Stream(0, 0, "x"), place)[:3, 3] == pytest.approx([1, 0, 0])


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
    "text": (lambda: D.Uniform("a", 1), UnitError, "finite number"),
    "shapes": (lambda: D.Uniform([0, 0], [1, 1, 1]), ShapeError, "one shape"),
    "log of zero": (lambda: D.LogUniform(0, 1), UnitError, "greater than zero"),
    "negative deviation": (lambda: D.Normal(0, -1), UnitError, "std"),
    "mean outside": (lambda: D.Normal(5, 0, low=0, high=1), UnitError, "outside of"),
    "too far apart": (lambda: D.Uniform(-1.7e308, 1.7e308), UnitError, "more than floats hold"),
    "nothing left": (lambda: D.Normal(0, 1, low=40), UnitError, "next to nothing"),
    "empty choice": (lambda: D.Choice([]), SceneError, "at least one"),
    "choice of a text": (lambda: D.Choice("abc"), SceneError, "list of values"),
    "weights": (lambda: D.Choice([1, 2], weights=[1]), UnitError, "2 weights"),
    "no weight": (lambda: D.Choice([1, 2], weights=[0, 0]), UnitError, "greater than zero"),
    "axis": (lambda: D.Turn([0, 0, 0]), UnitError, "length"),
    "about": (lambda: D.Turn(about="me"), ArgumentError, "self"),
    "compose": (lambda: D.Compose([1]), SceneError, "distributions"),
    "scale": (lambda: D.Scale(-1, 1), UnitError, "at least 0"),
    "same": (lambda: D.Uniform(0, 1, same="no"), ArgumentError, "True or False"),
}


@pytest.mark.parametrize("wrong", WRONG)
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
    "nothing described": (D.Scale(1, 2), Place("box.bsdf", ANYTHING), SceneError, "no parameter"),
}


@pytest.mark.parametrize("wrong", PLACES)
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


def test_short_forms():
    assert read_distribution("x", {"uniform": [0, 1]}) == D.Uniform(0, 1)
    assert read_distribution("x", {"choice": ["a", "b"]}) == D.Choice(["a", "b"])
    steps = {"compose": [{"turn": {}}, {"offset": [0, 1]}]}
    assert read_distribution("x", steps) == D.Compose([D.Turn(), D.Offset(0, 1)])
    for wrong in ({"uniform": [0]}, {"unifrm": [0, 1]}, {"uniform": {"lo": 1}}, 3, {"uniform": {"low": 1}}, {}):
        with pytest.raises(SceneError, match="uniform"):
            read_distribution("x", wrong)

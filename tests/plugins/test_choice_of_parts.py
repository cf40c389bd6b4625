"""Which part of a mixture a number chooses, its weight over the probability, and where weights are at an end."""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.surface_samples import start
from torchtransient.plugins.bsdfs.mixtures import LEAST_PROBABILITY, Choice, Leaf, Sides, _descend

COUNT = 2000


@pytest.fixture(autouse=True)
def mono(request):
    start(request, "llvm_ad_mono")


class Weights:
    """A texture of the same weight everywhere."""

    def __init__(self, value):
        self.value = mi.Float(value)

    def eval_1(self, si, active=True):
        return self.value


def descended(tree, z=1.0, at_ends=False):
    """(indices, weights, whether at an end) for numbers all over the unit interval."""
    u = (dr.arange(mi.Float, COUNT) + 0.5) / COUNT
    index, weight, end = _descend(tree, SimpleNamespace(wi=mi.Vector3f(0, 0, z)), u, mi.Bool(True), at_ends)
    return tuple(np.broadcast_to(np.array(x), COUNT) for x in (index, weight, end))


@pytest.mark.parametrize("w", [0.0, 0.02, 0.3, 0.97, 1.0])
@pytest.mark.parametrize("at_ends", [False, True])
def test_parts_have_their_weights_on_average(w, at_ends):
    index, weight, end = descended(Choice(Weights(w), Leaf(3), Leaf(5)), at_ends=at_ends)
    for part, share in ((3, 1 - w), (5, w)):
        chosen = index == part
        assert weight[chosen].sum() / COUNT == pytest.approx(share, abs=1e-3)
        drawn = np.clip(share, LEAST_PROBABILITY, 1 - LEAST_PROBABILITY) if at_ends else share
        assert chosen.mean() == pytest.approx(drawn, abs=1e-3)
    assert end.all() == end.any() == (at_ends and not 0.05 <= w <= 0.95)


@pytest.mark.parametrize(("w", "share"), [(-0.5, 0.0), (1.5, 1.0)])
def test_weights_beyond_their_range(w, share):
    index, weight, _ = descended(Choice(Weights(w), Leaf(0), Leaf(1)))
    assert (index == share).all() and (weight == 1).all()


@pytest.mark.parametrize(("w", "at_end"), [(0.05, False), (0.0499, True), (0.95, False), (0.9501, True)])
def test_where_an_end_begins(w, at_end):
    below = Choice(Weights(0.5), Choice(Weights(w), Leaf(0), Leaf(1)), Leaf(2))
    for tree in (Choice(Weights(w), Leaf(0), Leaf(1)), below, Choice(Weights(w), below.second, Leaf(4))):
        assert (descended(tree, at_ends=True)[2] == at_end).all()
    # Beside it, too: the part that is not chosen has a say.
    second = Choice(Weights(0.5), Leaf(2), Choice(Weights(w), Leaf(0), Leaf(1)))
    assert (descended(second, at_ends=True)[2] == at_end).all()


def test_what_is_left_of_a_number_chooses_again():
    inner, other = Choice(Weights(0.25), Leaf(1), Leaf(2)), Choice(Weights(0.7), Leaf(3), Leaf(4))
    index, weight, _ = descended(Choice(Weights(0.4), inner, other))
    expected = [0.6 * 0.75, 0.6 * 0.25, 0.4 * 0.3, 0.4 * 0.7]
    np.testing.assert_allclose([(index == part).mean() for part in (1, 2, 3, 4)], expected, atol=2e-3)
    np.testing.assert_allclose(weight, 1, rtol=1e-6)


@pytest.mark.parametrize(("z", "part"), [(0.3, 7), (-0.3, 8), (0.0, 8)])
def test_faces(z, part):
    assert (descended(Sides(Leaf(7), Leaf(8)), z)[0] == part).all()


@pytest.mark.parametrize(("w", "p"), [(0.0, 0.25), (0.3, 0.3), (1.0, 0.75)])
def test_slopes_of_weights(w, p):
    """Of the weight alone, over a probability that does not follow: up for the second part, down for the first."""
    texture = Weights(w)
    dr.enable_grad(texture.value)
    for u, slope in ((0.5 * p, 1 / p), (0.5 * (1 + p), -1 / (1 - p))):
        si = SimpleNamespace(wi=mi.Vector3f(0, 0, 1))
        _, weight, _ = _descend(Choice(texture, Leaf(0), Leaf(1)), si, mi.Float(u), mi.Bool(True), True)
        dr.backward(weight)
        assert dr.grad(texture.value)[0] == pytest.approx(slope, rel=1e-6)
        dr.set_grad(texture.value, 0)

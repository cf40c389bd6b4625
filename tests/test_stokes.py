"""Stokes vectors in torch: measures, frames, ideal elements, derivatives."""

import math

import numpy as np
import pytest
import torch

from torchtransient import stokes as st

MEASURES = [
    st.degree_of_polarization,
    st.degree_of_linear_polarization,
    st.degree_of_circular_polarization,
    st.angle_of_linear_polarization,
    st.normalized_components,
]


def light(s0, s1, s2, s3):
    return torch.tensor([s0, s1, s2, s3], dtype=torch.float64)


def random_light(*shape, dim):
    """Partly polarised light, seeded."""
    generator = torch.Generator().manual_seed(5)
    v = torch.randn(3, *shape, generator=generator, dtype=torch.float64)
    s0 = v.norm(dim=0, keepdim=True) * (1 + torch.rand(1, *shape, generator=generator, dtype=torch.float64))
    return torch.cat([s0, v]).movedim(0, dim)


@pytest.mark.parametrize(
    ("vector", "dop", "dolp", "docp", "aolp"),
    [
        ((2, 0, 0, 0), 0, 0, 0, 0),
        ((2, 2, 0, 0), 1, 1, 0, 0),
        ((2, -1, 0, 0), 0.5, 0.5, 0, math.pi / 2),
        ((1, 0, 1, 0), 1, 1, 0, math.pi / 4),
        ((1, 0, -1, 0), 1, 1, 0, -math.pi / 4),
        ((4, 0, 0, -4), 1, 0, -1, 0),
        ((5, 0, 3, 4), 1, 0.6, 0.8, math.pi / 4),
        ((0, 0, 0, 0), 0, 0, 0, 0),
    ],
)
def test_known_states(vector, dop, dolp, docp, aolp):
    s = light(*vector)
    assert st.degree_of_polarization(s, 0).item() == pytest.approx(dop, abs=1e-15)
    assert st.degree_of_linear_polarization(s, 0).item() == pytest.approx(dolp, abs=1e-15)
    assert st.degree_of_circular_polarization(s, 0).item() == pytest.approx(docp, abs=1e-15)
    assert st.angle_of_linear_polarization(s, 0).item() == pytest.approx(aolp, abs=1e-15)


@pytest.mark.parametrize("function", MEASURES)
@pytest.mark.parametrize(("shape", "dim"), [((2, 4, 1, 3, 2, 2), st.TRANSIENT_DIM), ((4, 3, 2, 2), st.STEADY_DIM)])
def test_shapes_and_layout(function, shape, dim):
    rest = [n for i, n in enumerate(shape) if i != len(shape) + dim]
    s = random_light(*rest, dim=dim)
    assert s.shape == shape
    result = function(s, dim)
    expected = list(rest)
    if function is st.normalized_components:
        expected.insert(len(shape) + dim, 3)
    assert list(result.shape) == expected
    # The same entry by itself
    one = s[0, :, 0, 1, 1, 0] if len(shape) == 6 else s[:, 0, 1, 1]
    alone = function(one, 0)
    here = result[0, ..., 0, 1, 1, 0] if len(shape) == 6 else result[..., 0, 1, 1]
    torch.testing.assert_close(here, alone)


@pytest.mark.parametrize("function", MEASURES)
def test_gradcheck(function):
    s = random_light(2, 3, dim=0).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: function(x, 0), (s,))


def test_dark_below_the_floor():
    s = torch.stack([light(1e-3, 1e-3, 0, 0), light(1.0, 1.0, 0, 0)], dim=1)
    assert st.degree_of_polarization(s, 0, floor=0.01).tolist() == [0, 1]
    assert st.normalized_components(s, 0, floor=0.01)[0].tolist() == [0, 1]


def test_rotating_the_frame():
    s = random_light(5, 2, dim=0)
    angle = torch.tensor([[0.3], [0.0], [-1.0], [2.0], [math.pi / 4]], dtype=torch.float64)
    turned = st.rotate_frame(s, angle, 0)
    for f in (st.degree_of_polarization, st.degree_of_circular_polarization):
        torch.testing.assert_close(f(turned, 0), f(s, 0))
    difference = st.angle_of_linear_polarization(s, 0) - st.angle_of_linear_polarization(turned, 0) - angle
    torch.testing.assert_close(torch.sin(difference), torch.zeros_like(difference), atol=1e-12, rtol=0)
    torch.testing.assert_close(st.rotate_frame(turned, -angle, 0), s)
    one = st.rotate_frame(s, 0.7, 0)
    torch.testing.assert_close(one, st.apply_mueller(st.rotator(0.7), s, 0))


def test_rotated_elements_are_elements_in_a_turned_frame():
    r = st.rotator(torch.tensor(0.4, dtype=torch.float64))
    for element in (lambda a: st.linear_polarizer(a, 0.01), lambda a: st.linear_retarder(a, 1.1)):
        at_zero, turned = (element(torch.tensor(a, dtype=torch.float64)) for a in (0.0, 0.4))
        torch.testing.assert_close(turned, r.T @ at_zero @ r)


def test_elements_do_what_their_names_say():
    unpolarised = light(1, 0, 0, 0)
    # Malus' law
    first = st.apply_mueller(st.linear_polarizer(0.2), unpolarised, 0)
    for angle in (0.2, 0.7, 0.2 + math.pi / 2):
        second = st.apply_mueller(st.linear_polarizer(torch.tensor(angle, dtype=torch.float64)), first, 0)
        assert second[0].item() == pytest.approx(0.5 * math.cos(angle - 0.2) ** 2, abs=1e-7)
    # A half-wave plate at a turns light at b to 2a - b
    half = st.apply_mueller(st.linear_retarder(0.5, math.pi), first, 0)
    assert st.angle_of_linear_polarization(half, 0).item() == pytest.approx(0.8, abs=1e-6)
    # A quarter-wave plate with its fast axis at +45 degrees makes horizontal light right circular, at -45 left
    quarter = st.apply_mueller(st.linear_retarder(-math.pi / 4, math.pi / 2), light(1, 1, 0, 0), 0)
    torch.testing.assert_close(quarter, light(1, 0, 0, -1), atol=1e-6, rtol=0)
    quarter = st.apply_mueller(st.linear_retarder(math.pi / 4, math.pi / 2), light(1, 1, 0, 0), 0)
    torch.testing.assert_close(quarter, light(1, 0, 0, 1), atol=1e-6, rtol=0)
    assert st.apply_mueller(st.circular_polarizer(), quarter, 0)[0].item() == pytest.approx(1)
    assert st.apply_mueller(st.circular_polarizer(left_handed=True), quarter, 0)[0].item() == pytest.approx(0)
    torch.testing.assert_close(st.apply_mueller(st.depolarizer(), quarter, 0), light(1, 0, 0, 0))


@pytest.mark.parametrize(
    "element", [st.rotator, lambda a: st.linear_polarizer(a, a), lambda a: st.linear_retarder(a, a)]
)
def test_gradcheck_of_elements(element):
    angle = torch.tensor([0.3, 0.9], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(element, (angle,))
    assert element(angle).shape == (2, 4, 4)


def test_an_ideal_polarizer_has_a_derivative_by_its_extinction():
    """The diagonal: half of what is let through, along and across; the root of the cross terms is left out."""
    extinction = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(st.linear_polarizer(0.0, extinction)[0].sum(), extinction)
    assert slope.item() == pytest.approx(0.0)  # (1 + e) / 2 + (1 - e) / 2
    (slope,) = torch.autograd.grad(st.linear_polarizer(0.3, extinction)[0, 0], extinction)
    assert slope.item() == pytest.approx(0.5)


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize("floor", [0.0, 0.5])
def test_light_that_is_no_number_has_no_measure(measure, floor):
    given = light(1.0, 1.0, 0.75, 0.125).expand(5, 4).T.clone()
    given.diagonal().fill_(math.nan)
    found = measure(given, 0, floor).isnan()
    found = found.any(0) if found.ndim == 2 else found
    touched = {"angle": [0, 1, 1, 0, 0], "degree_of_circular": [1, 0, 0, 1, 0], "degree_of_linear": [1, 1, 1, 0, 0]}
    expected = next((row for name, row in touched.items() if measure.__name__.startswith(name)), [1, 1, 1, 1, 0])
    assert found.tolist() == [bool(entry) for entry in expected]
    everything = torch.full((4,), math.nan, requires_grad=True)
    assert torch.autograd.grad(measure(everything, 0).sum(), everything)[0].isnan().any()


def test_precision_of_angles_and_matrices():
    assert st.rotator(0.1).dtype == st.rotator([1, 2]).dtype == torch.float32
    assert st.rotator(np.float64(0.1)).dtype == torch.float64
    horizontal = light(1.0, 1.0, 0.0, 0.0)
    torch.testing.assert_close(st.rotate_frame(horizontal, 0.1, 0)[1], torch.tensor(math.cos(0.2), dtype=torch.float64))
    matrix = [[0.1 if i == j else 0.0 for i in range(4)] for j in range(4)]
    assert torch.equal(st.apply_mueller(matrix, horizontal, 0), 0.1 * horizontal)

"""Mueller matrices and Stokes frames against amplitudes in double precision: Born and Wolf, 1.5 and 14.2."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from torchtransient import plugins
from torchtransient.plugins import polarized
from torchtransient.plugins.bsdfs.fresnel import Interface, across_plane, metal_reflection, two_by_two

VARIANT = "llvm_ad_mono_polarized"
COSINES = np.array([1.0, 0.93, 0.7, 0.5, 0.31, 0.12, 0.01])


@pytest.fixture(autouse=True)
def mono():
    mi.set_variant(VARIANT)
    plugins.sync()


def entries(matrix):
    """(4, 4, lanes)"""
    values = [matrix[i, j] for i in range(4) for j in range(4)]
    dr.eval(values)
    width = max(dr.width(x) for x in values)
    return np.array([np.broadcast_to(np.array(x).ravel(), width) for x in values], dtype=float).reshape(4, 4, -1)


def of_amplitudes(s, p, factor=1.0):
    """The matrix of an element with these amplitudes along its axes; ``s`` is horizontal."""
    a, b = (abs(s) ** 2 + abs(p) ** 2) / 2, (abs(s) ** 2 - abs(p) ** 2) / 2
    c, d, o = (s * np.conj(p)).real, (s * np.conj(p)).imag, 0 * a
    return factor * np.array([[a, b, o, o], [b, a, o, o], [o, o, c, d], [o, o, -d, c]])


def amplitudes(c, n):
    """Reflected and transmitted ones for light from the thin side of an index ``n``, Verdet's signs."""
    n = n + 0j
    t = np.conj(np.sqrt(1 - (1 - c * c) / n**2))  # the wave that decays
    s, p = (c - n * t) / (c + n * t), (n * c - t) / (n * c + t)
    return s, p, 2 * c / (c + n * t), 2 * c / (n * c + t), n * t / c


@pytest.mark.parametrize("index", [1.5, 4.0, 0.6, 1.0625])
@pytest.mark.parametrize("side", [1, -1])
def test_interfaces(index, side):
    """Total reflection included."""
    n = index if side > 0 else 1 / index
    s, p, ts, tp, share = amplitudes(COSINES, n)
    interface = Interface(mi.Float(side * COSINES), mi.Float(index))
    total = 1 - n**2 >= COSINES**2
    assert total.any() == (n < 1)
    np.testing.assert_allclose(entries(interface.reflection()), of_amplitudes(s, p), atol=3e-6)
    expected = of_amplitudes(ts, tp, np.where(total, 0, share.real))
    np.testing.assert_allclose(entries(interface.transmission()), expected, atol=3e-6)
    # What is not reflected passes.
    passed = entries(interface.reflection())[0, 0] + entries(interface.transmission())[0, 0]
    np.testing.assert_allclose(passed, 1, rtol=1e-6)


def test_an_interface_that_is_not_there():
    for cosine in (1.0, 0.3, 0.0, -0.0, -0.4):
        interface = Interface(mi.Float(cosine), mi.Float(1.0))
        reflected = entries(interface.reflection())[..., 0]
        if cosine:
            np.testing.assert_allclose(reflected, 0, atol=1e-12)
            np.testing.assert_allclose(entries(interface.transmission())[..., 0], np.eye(4), atol=1e-6)
        else:
            # Along it all is reflected, and phases have no meaning.
            np.testing.assert_allclose(reflected, np.eye(4))
            np.testing.assert_allclose(entries(interface.transmission())[..., 0], 0)


@pytest.mark.parametrize(("eta", "k"), [(0.2, 3.0), (1.5, 0.4), (2.8, 3.2), (0.05, 0.3), (1.4, 0.0), (0.0, 2.0)])
def test_metals(eta, k):
    """Of the complex index `eta - i k`."""
    c = COSINES[:-1]
    n = complex(eta, -k)
    root = np.sqrt(n * n - (1 - c * c) + 0j)
    root = np.where(root.imag > 0, -root, root)
    s, p = (c - root) / (c + root), (n * n * c - root) / (n * n * c + root)
    found = entries(metal_reflection(mi.Float(c), mi.UnpolarizedSpectrum(eta), mi.UnpolarizedSpectrum(k)))
    expected = of_amplitudes(s, p)
    np.testing.assert_allclose(found, expected, atol=5e-6)
    with mi.variant_context("llvm_ad_mono"):
        mean = metal_reflection(mi.Float(c), mi.UnpolarizedSpectrum(eta), mi.UnpolarizedSpectrum(k))
        np.testing.assert_allclose(np.array(mean).ravel(), expected[0, 0], atol=5e-6)


def test_a_metal_that_is_not_there():
    """Along it the derivatives are numbers, too."""
    for cosine in (0.0, 0.5):
        c, eta, k = mi.Float(cosine), mi.UnpolarizedSpectrum(1.0), mi.UnpolarizedSpectrum(0.0)
        dr.enable_grad(c, eta, k)
        found = metal_reflection(c, eta, k)
        total = sum(found[i, j][0] * (1 + i - 0.3 * j) for i in range(4) for j in range(4))
        dr.backward(total, flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
        for number in (total, *map(dr.grad, (c, eta, k))):
            assert np.isfinite(np.array(number)).all()
    assert abs(float(dr.detach(found)[0, 0][0][0])) < 1e-6


def test_the_places_of_the_entries():
    found = entries(two_by_two(mi.Float(2), mi.Float(3), mi.Float(5), mi.Float(7)))[..., 0]
    assert found.tolist() == [[2, 3, 0, 0], [3, 2, 0, 0], [0, 0, 5, -7], [0, 0, 7, 5]]


def test_matrices_between_the_frames_of_directions():
    """A plane of incidence that is turned about the normal by an angle turns both frames; along the normal none is."""
    normal, m = mi.Vector3f(0, 0, 1), matrix(5)

    def frame_turn(forward, horizontal):
        implicit = np.array(mi.coordinate_system(mi.Vector3f(*forward.tolist()))[0]).ravel()
        horizontal = horizontal / np.linalg.norm(horizontal)
        return turn(math.atan2(forward @ np.cross(horizontal, implicit), horizontal @ implicit))

    wi, wo = np.array([0.36, 0.48, 0.8]), np.array([-0.36, -0.48, 0.8])
    up = np.array([0.0, 0, 1])
    found = across_plane(as_spectrum(m), normal, *(mi.Vector3f(*d.tolist()) for d in (wi, wo)))
    expected = frame_turn(wi, np.cross(up, wi)) @ m @ frame_turn(-wo, np.cross(up, -wo)).T
    np.testing.assert_allclose(entries(found)[..., 0], expected, atol=1e-5)
    found = across_plane(as_spectrum(m), normal, normal, normal)
    x = np.array([1.0, 0, 0])
    np.testing.assert_allclose(entries(found)[..., 0], frame_turn(up, x) @ m @ frame_turn(-up, x).T, atol=1e-5)


# ------------------------------------------------------------------------------------------------------------- frames


def matrix(seed):
    return np.random.default_rng(seed).uniform(-2, 2, (4, 4)).round(2)


def as_spectrum(m):
    return mi.Spectrum(*[mi.UnpolarizedSpectrum(x) for x in np.ravel(m).tolist()])


def as_stokes(v):
    return mi.SpectrumEntry(*[mi.UnpolarizedSpectrum(x) for x in v])


def numbers(stokes):
    return np.array([float(np.array(stokes[i]).ravel()[0]) for i in range(4)])


def turn(angle):
    """Of the frame by an angle, counter-clockwise for the receiver."""
    c, s = math.cos(2 * angle), math.sin(2 * angle)
    return np.array([[1, 0, 0, 0], [0, c, s, 0], [0, -s, c, 0], [0, 0, 0, 1.0]])


def test_products():
    a, b, v = matrix(1), matrix(2), [1.0, 0.5, -0.25, 2.0]
    np.testing.assert_allclose(entries(polarized.product(as_spectrum(a), as_spectrum(b)))[..., 0], a @ b, rtol=1e-5)
    np.testing.assert_allclose(numbers(polarized.product(as_spectrum(a), as_stokes(v))), a @ v, rtol=1e-5)
    np.testing.assert_allclose(numbers(polarized.first_column(as_spectrum(a))), a[:, 0], rtol=1e-6)
    dimmed = polarized.attenuated(as_spectrum(a), mi.UnpolarizedSpectrum(0.25))
    np.testing.assert_allclose(entries(dimmed)[..., 0], a / 4, rtol=1e-6)
    assert float(np.array(polarized.intensity(as_stokes(v))).ravel()[0]) == 1.0


@pytest.mark.parametrize("angle", [0.0, -0.7, 2.5])
def test_turns_of_a_frame(angle):
    """By vectors of any length, and by products of matrices."""
    forward, current = mi.Vector3f(0, 0, 1), mi.Vector3f(3, 0, 0)
    target = 0.2 * mi.Vector3f(math.cos(angle), math.sin(angle), 0)
    rotation = polarized.rotation_between(forward, current, target)
    assert [rotation.c[0], rotation.s[0]] == pytest.approx([math.cos(2 * angle), math.sin(2 * angle)], abs=1e-6)
    v = [1.0, 0.5, -0.25, 2.0]
    np.testing.assert_allclose(numbers(polarized.rotate_stokes(as_stokes(v), rotation)), turn(angle) @ v, atol=1e-6)
    other = polarized.rotation_along(mi.Float(2 * math.cos(0.4)), mi.Float(2 * math.sin(0.4)))
    found = polarized.rotate_mueller(as_spectrum(matrix(3)), rotation, other)
    np.testing.assert_allclose(entries(found)[..., 0], turn(angle) @ matrix(3) @ turn(0.4).T, atol=1e-5)
    found = polarized.scatter_unpolarized(as_spectrum(matrix(3)), rotation)
    np.testing.assert_allclose(numbers(found), turn(angle) @ matrix(3)[:, 0], atol=1e-6)


def test_the_frame_of_a_segment():
    """One fixed vector across the ray, whatever is attached."""
    d = mi.Vector3f(0.48, 0.6, 0.64)
    dr.enable_grad(d)
    frame = polarized.stokes_frame_of(d)
    assert not dr.grad_enabled(frame)
    expected = mi.coordinate_system(-mi.Vector3f(0.48, 0.6, 0.64))[0]
    np.testing.assert_array_equal(np.array(frame), np.array(expected))


def test_no_turn_without_a_direction():
    rotation = polarized.rotation_along(mi.Float(0), mi.Float(0))
    assert (rotation.c[0], rotation.s[0]) == (1, 0)
    tiny = polarized.rotation_along(mi.Float(3e-18), mi.Float(4e-18))
    assert [tiny.c[0], tiny.s[0]] == pytest.approx([-7 / 25, 24 / 25], rel=1e-5)


def test_the_derivative_of_a_turn():
    """Of twice the angle, and what it makes of a throughput of one whose frame turns."""
    x = mi.Float(0.35)
    dr.enable_grad(x)
    rotation = polarized.rotation_along(dr.cos(x), dr.sin(x))
    angle = rotation.angle()
    assert angle[0] == pytest.approx(0, abs=1e-7)
    dr.forward(x)
    assert dr.grad(angle)[0] == pytest.approx(2, rel=1e-5)
    h = 1e-6
    expected = (turn(h / 2) - turn(-h / 2)) / (2 * h)
    np.testing.assert_allclose(entries(polarized.rotation_tangent(mi.Float(1.0)))[..., 0], expected, atol=1e-9)


def test_matrices_of_mirror_images():
    """Between frames of directions that are mirrored at the surface: the hands of all three axes are exchanged."""
    wi, wo = np.array([0.48, 0.6, 0.64]), np.array([-0.36, 0.48, 0.8])
    flip = np.diag([1.0, 1, -1])

    def frame(d):
        return np.array(mi.coordinate_system(mi.Vector3f(*d.tolist()))[0]).ravel()

    def angle(forward, one, other):
        return math.atan2(forward @ np.cross(one, other), one @ other)

    out = turn(angle(wi, flip @ frame(flip @ wi), frame(wi)))
    into = turn(angle(-wo, flip @ frame(flip @ -wo), frame(-wo)))
    hands = np.diag([1.0, 1, -1, -1])
    m = matrix(4)
    vectors = [mi.Vector3f(*d.tolist()) for d in (wi, wo)]
    found = polarized.from_mirrored_frames(as_spectrum(m), *vectors, mi.Mask([True, False]))
    np.testing.assert_allclose(entries(found)[..., 0], out @ hands @ m @ hands @ into.T, atol=1e-5)
    np.testing.assert_allclose(entries(found)[..., 1], m, rtol=1e-6)


def test_without_polarization_all_of_it_is_plain_numbers():
    with mi.variant_context("llvm_ad_rgb"):
        a, b = mi.Color3f(0.5, 0.25, 2.0), mi.Color3f(3.0, 2.0, 0.5)
        assert polarized.light_type() is mi.UnpolarizedSpectrum
        for found in (polarized.product(a, b), polarized.attenuated(a, b)):
            assert np.array(found).ravel().tolist() == [1.5, 0.5, 1.0]
        for found in (polarized.intensity(a), polarized.first_column(a), polarized.rotate_stokes(a, None),
                      polarized.scatter_unpolarized(a, None), polarized.rotate_mueller(a, None, None)):  # fmt: skip
            assert np.array(found).ravel().tolist() == [0.5, 0.25, 2.0]
        si = dr.zeros(mi.SurfaceInteraction3f)
        assert polarized.rotation_to_sensor(si, si.wi) is polarized.rotation_from_light(si, si.wi) is None
    assert polarized.light_type() is mi.SpectrumEntry


def test_grazing_incidence_on_an_interface_that_is_not_there():
    """All is reflected as it is, and nothing passes."""
    surface = Interface(mi.Float(0.0), mi.Float(1.0))
    np.testing.assert_array_equal(entries(surface.reflection())[..., 0], np.eye(4))
    np.testing.assert_array_equal(entries(surface.transmission()), 0)


@pytest.mark.parametrize("side", [1, -1])
def test_grazing_incidence(side):
    """All is reflected, and both amplitudes turn over."""
    surface = Interface(mi.Float(side * 1e-19), mi.Float(1.5 ** side))
    np.testing.assert_allclose(entries(surface.reflection())[..., 0], np.eye(4), atol=1e-6)
    np.testing.assert_allclose(entries(surface.transmission())[..., 0], 0, atol=1e-6)


def test_where_an_interface_that_is_not_there_lets_light_pass():
    """From a cosine on whose reciprocal single precision can square."""
    least = np.float32(1e-18) / 2
    for cosine, passes in ((least, 1), (np.nextafter(least, np.float32(0)), 0), (10 * least, 1)):
        passed = entries(Interface(mi.Float(float(cosine)), mi.Float(1.0)).transmission())[..., 0]
        np.testing.assert_allclose(passed, passes * np.eye(4), rtol=1e-5)

"""Pictures of Stokes vectors and of phasors, against light that is known."""

from __future__ import annotations

import matplotlib
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.cubes import read_gif
from support.sweeps import together
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.vis import colour_maps

NAN = float("nan")


def shown(figure, panel=0):
    return figure.axes[panel].images[0].get_array()


def light():
    """Four pixels: horizontal, at +45 degrees of half the degree, right circular, dark."""
    vectors = torch.tensor([[1.0, 1, 0, 0], [2.0, 0, 1, 0], [1.0, 0, 0, 1], [0.0, 0, 0, 0]])
    return vectors.T.reshape(4, 1, 2, 2)


def test_degrees():
    names = ("dop", "dolp", "docp")
    figure = tt.vis.polarization_picture(light(), quantities=names)
    expected = {"dop": [1, 0.5, 1], "dolp": [1, 0.5, 0], "docp": [0, 0, 1]}
    for panel, name in enumerate(names):
        image = shown(figure, panel)
        np.testing.assert_allclose(np.ma.filled(image, NAN).ravel()[:3], expected[name], atol=1e-12)
        assert np.isnan(np.ma.filled(image, NAN).ravel()[3])  # dark: grey, not a degree of zero
    assert [figure.axes[k].images[0].get_clim() for k in range(3)] == [(0, 1), (0, 1), (-1, 1)]


@pytest.mark.parametrize("angle_map", ["even", "hsv"])
def test_angle(angle_map):
    figure = tt.vis.polarization_picture(light(), quantities=("aolp",), angle_map=angle_map)
    image = np.asarray(shown(figure)).reshape(4, 3)
    bar = colour_maps.cyclic_map(angle_map)
    np.testing.assert_allclose(image[0], bar(128)[:3], atol=0.02)  # the colour that the bar shows at 0 degrees
    hue_at_45 = np.array(bar(192)[:3])
    grey = image[2]
    assert np.ptp(grey) < 1e-3  # circular light has no angle
    np.testing.assert_allclose(image[1], grey + np.sqrt(0.5) * (hue_at_45 - grey), atol=0.02)
    assert np.ptp(image[3]) == 0 and image[3, 0] < grey[0]


def test_angle_has_no_jump_at_its_ends():
    angle = torch.tensor([np.pi / 2 - 1e-4, -np.pi / 2 + 1e-4])
    vectors = torch.stack([torch.ones(2), torch.cos(2 * angle), torch.sin(2 * angle), torch.zeros(2)])
    image = shown(tt.vis.polarization_picture(vectors[:, None, None].double(), quantities=("aolp",)))
    np.testing.assert_allclose(image[0, 0], image[0, 1], atol=1e-3)


def test_more_than_polarized_is_polarized():
    """Noise may say so; a floor of zero keeps all that is lit."""
    vectors = torch.tensor([[1.0, 1.0], [3.0, 0.0], [0.0, 0.25], [0.0, 0.0]])[:, None, None].double()
    image = np.asarray(shown(tt.vis.polarization_picture(vectors, quantities=("aolp",))))[0]
    grey = colour_maps.oklch(0.75, 0.0, 0.0)
    np.testing.assert_allclose(image[0], colour_maps.cyclic(0.0), atol=1e-9)
    np.testing.assert_allclose(image[1], grey + 0.5 * (colour_maps.cyclic(0.25) - grey), atol=1e-9)
    weak = torch.tensor([1e-9, 0.0, 1.0, 4.0]).reshape(1, 1, 1, 4) * torch.tensor([1.0, 0.5, 0, 0]).reshape(4, 1, 1, 1)
    drawn = shown(tt.vis.polarization_picture(weak, quantities=("dolp",), floor=0.0))
    np.testing.assert_array_equal(np.ma.getmaskarray(drawn), [[False, True, False, False]])


def test_components_are_centred_at_zero():
    figure = tt.vis.polarization_picture(light(), quantities=("s1", "s2", "s3"))
    for panel, component in enumerate((1, 2, 3)):
        low, high = figure.axes[panel].images[0].get_clim()
        assert low == -high
        np.testing.assert_allclose(shown(figure, panel), light()[component, 0].numpy())


def test_one_bin_of_a_transient(tmp_path):
    cube = torch.zeros(4, 3, 5, 2, 2)
    cube[:, :, 2] = light().expand(4, 3, 2, 2)
    cube[0, :, 4] = 1.0
    path = tmp_path / "p.png"
    at_once = tt.vis.polarization_picture(cube, path, quantities=("dop",))
    assert path.read_bytes()[:4] == b"\x89PNG"
    assert np.ma.filled(shown(at_once), NAN).ravel()[0] == pytest.approx(0.5)
    one = tt.vis.polarization_picture(cube, quantities=("dop",), frame=2)
    assert np.ma.filled(shown(one), NAN).ravel()[0] == pytest.approx(1.0)


def test_broken_pixels_have_no_degree():
    vectors = light().clone()
    vectors[1, 0, 0, 0] = NAN
    figure = tt.vis.polarization_picture(vectors, quantities=("dolp", "intensity"))
    assert np.isnan(np.ma.filled(shown(figure, 0), NAN)[0, 0])
    assert np.asarray(shown(figure, 1))[0, 0].tolist() == [1.0, 0.0, 1.0]
    tt.vis.polarization_picture(torch.zeros(4, 1, 3, 3))  # no light at all


# ----------------------------------------------------------------------------------------------------- phasors


def wave():
    """Amplitude 2, phase one turn over eight columns, as light that arrives later to the right: exp(-2 pi i nu opl)."""
    turns = -torch.arange(8) / 8
    row = 2 * torch.exp(2j * torch.pi * turns)
    return row.expand(1, 1, 3, 8).to(torch.complex64)


def test_domain_colours():
    """Hue by phase, brightness by amplitude; what is not finite is grey."""
    values = torch.tensor([1, 0.25, 0, 1j, NAN * 1j]).reshape(1, 1, 1, 5).to(torch.complex128)
    image = np.asarray(shown(tt.vis.phasor_picture(values, show=("domain",))))[0]
    np.testing.assert_allclose(image[0], colour_maps.cyclic(0.0, 1.0))
    np.testing.assert_allclose(image[1], colour_maps.cyclic(0.0, 0.5))
    np.testing.assert_allclose(image[3], colour_maps.cyclic(0.25, 1.0))
    assert image[2].max() == 0 and image[4].tolist() == [0.5] * 3


def test_labels():
    axis = tt.FrequencyAxis((0.0, 1e8 / 299792458.0))
    figure = tt.vis.phasor_picture(wave().repeat(1, 2, 1, 1), show=("real",), which=(0, 1), frequencies=axis)
    assert "steady" in figure.axes[0].get_title() and "3 m (100 MHz)" in figure.axes[1].get_title()


def test_crests_run_from_early_to_late(tmp_path):
    """The row lights up to the right as time goes on, one column for each of eight steps."""
    path = tt.vis.phasor_video(wave(), tmp_path / "w.gif", steps=8, scale=10)
    frames, _ = read_gif(path)
    assert len(frames) == 8
    reddest = 255 * np.array(matplotlib.colormaps["RdBu_r"](1.0)[:3])
    crest = [int(np.argmin(np.abs(f[5, 5:80:10] - reddest).sum(-1))) for f in frames]
    assert [(c - crest[0]) % 8 for c in crest] == list(range(8))


def test_colours_of_what_is_dark_or_broken():
    """Phases are those of pixels above a ten-thousandth of the brightest; what is not finite is grey everywhere."""
    values = torch.tensor([[1.0, 1.2e-4, 0.9e-4j, NAN * 1j]]).to(torch.complex128)[None, None]
    shows = ("phase", "domain", "real", "amplitude")
    panels = tt.vis.phasor_picture(values, show=shows).axes[:4]
    phase, domain = (np.asarray(panel.images[0].get_array())[0] for panel in panels[:2])
    assert (np.ptp(phase, axis=-1) > 0.1).tolist() == [True, True, False, False]
    assert phase[2].tolist() == phase[3].tolist() == domain[3].tolist() == [0.5] * 3
    for panel, name in zip(panels[2:], ("RdBu_r", "inferno"), strict=True):
        cmap = panel.images[0].get_cmap()
        assert cmap.name == name and cmap(np.nan)[:3] == (0.5, 0.5, 0.5)


@together("draw, arguments, error", [
    (tt.vis.polarization_picture, {"quantities": ("dolp", "colour")}, ArgumentError),
    (tt.vis.polarization_picture, {"angle_map": "jet"}, ArgumentError),
    (tt.vis.polarization_picture, {"source": torch.ones(3, 4, 4)}, ShapeError),
    (tt.vis.phasor_picture, {"which": (1,)}, IndexError),
    (tt.vis.phasor_picture, {"frequencies": (1.0, 2.0)}, ShapeError),
    (tt.vis.phasor_picture, {"show": ("colour",)}, UnitError),
    (tt.vis.phasor_picture, {"source": torch.ones(1, 1, 2, 2)}, ShapeError),
])  # fmt: skip
def test_refused(draw, arguments, error):
    source = wave() if draw is tt.vis.phasor_picture else light()
    with pytest.raises(error):
        draw(**{"source": source} | arguments)

"""Frames as cameras hand them out: converters of differences, noise that light cannot give, other units."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchtransient import sensing
from torchtransient.axes import TimeAxis
from torchtransient.errors import PhysicsWarning, UnitError
from torchtransient.units import SPEED_OF_LIGHT

AXIS = TimeAxis.from_seconds(0.0, 100e-12, 500)
F = 60.6e6


def at(bin_index, electrons=2e4, size=1):
    light = torch.zeros(1, 500, size, size, dtype=torch.float64)
    light[:, bin_index] = electrons
    return light, (bin_index + 0.5) * 100e-12 * SPEED_OF_LIGHT / 2


def two_tap(code=None, *stages, grad="straight_through", **keywords):
    code = sensing.TwoTapCode(code or sensing.sine_code(4))
    return sensing.Compose([sensing.ItofCorrelation(code, F, AXIS, **keywords), *stages], grad=grad)


def converter(**keywords):
    return sensing.PixelElectronics(shot_noise=False, gain_e_per_dn=4.0, bits=12, **keywords)


# -------------------------------------------------------------------------------------- converters of a difference


@pytest.mark.parametrize("steps", [2, 5])
@pytest.mark.parametrize("how", [{"signed": True}, {"black_level_dn": 2048.0}], ids=["signed", "black level"])
def test_a_converter_behind_a_difference(steps, how):
    """Depth of the converter's numbers to half a step of 4 e, at every quarter of a turn."""
    chain = two_tap(sensing.sine_code(steps), sensing.PixelElectronics(), sensing.TapDifference(), converter(**how))
    for k in (0, 20, 60, 100, 140):
        light, true = at(k, 1.6e4)  # differences of up to 8000 e, within the range
        frames = chain.stages[-1](chain.stages[0](light)[:, 0::2] - chain.stages[0](light)[:, 1::2])
        found = sensing.read_itof(frames, F, steps, readout="differential")
        # N errors of half a step, 2 e, in (2 / N) sum X exp, whose size is 1.6e4 / N
        bound = 2 * 2 * steps / 1.6e4 * SPEED_OF_LIGHT / (4 * np.pi * F)
        assert abs(found.depth_m.item() - true) <= bound + 1e-6
        mean = sensing.read_itof(chain.expected(light), F, steps, readout="differential")
        assert abs(mean.depth_m.item() - true) <= 1e-6


@pytest.mark.parametrize("how", [{}, {"black_level_dn": 16.0}], ids=["from 0", "black level of 16"])
def test_a_converter_that_clips_differences_is_refused(how):
    with pytest.raises(UnitError, match=r"room below zero behind a TapDifference.*signed=True"):
        two_tap(None, sensing.PixelElectronics(), sensing.TapDifference(), converter(**how))
    with pytest.raises(UnitError, match="room below zero"):  # a chain in a chain
        sensing.Compose([two_tap(None, sensing.PixelElectronics(), sensing.TapDifference()), converter(**how)])


def test_no_shot_noise_of_a_difference():
    with pytest.raises(UnitError, match="no shot noise behind a TapDifference"):
        two_tap(None, sensing.TapDifference(), sensing.PixelElectronics())


def test_codes_in_twos_complement():
    signed = sensing.PixelElectronics(shot_noise=False, gain_e_per_dn=2.0, bits=3, signed=True)
    values = torch.tensor([-100.0, -8.0, -5.1, 0.0, 5.9, 6.1, 100.0]).reshape(1, 7, 1, 1)
    found = signed.sample(values).flatten().tolist()
    assert found == [-8.0, -8.0, -6.0, 0.0, 6.0, 6.0, 6.0]
    assert signed.range_e == (-8.0, 6.0) and signed.range_dn == (-4.0, 3.0)
    assert "signed=True" in repr(signed)
    shifted = sensing.PixelElectronics(shot_noise=False, gain_e_per_dn=2.0, bits=3, signed=True, black_level_dn=-2.0)
    assert shifted.range_e == (-4.0, 10.0)
    with pytest.raises(UnitError, match="bits of a signed converter"):
        sensing.PixelElectronics(signed=True)
    with pytest.raises(UnitError, match="black_level_dn"):
        sensing.PixelElectronics(gain_e_per_dn=2.0, bits=3, signed=True, black_level_dn=4.0)


# ---------------------------------------------------------------------------------------------- what is known of noise


def frames_of(*stages, size=24, seed=0, **keywords):
    chain = two_tap(None, *stages, **keywords)
    return chain.sample(at(100, size=size)[0], torch.Generator().manual_seed(seed))


def test_differences_that_are_read_as_taps_have_no_deviation():
    frames = frames_of(sensing.PixelElectronics(read_noise_e=20.0), sensing.TapDifference())
    with pytest.warns(PhysicsWarning, match="readout='differential'"):
        wrong = sensing.read_itof(frames, F, 4)
    assert bool(wrong.depth_std_m.isnan().all())
    with pytest.warns(PhysicsWarning):
        told = sensing.read_itof(frames, F, 4, noise=sensing.ItofNoise(read_noise_e=20.0))
    assert bool(told.depth_std_m.isnan().all())
    with pytest.warns(PhysicsWarning):  # or as two steps of two taps
        assert bool(sensing.read_itof(frames, F, 2, readout="two_tap").depth_std_m.isnan().all())
    known = sensing.ItofNoise(read_noise_e=20.0, offset_e=2e4 / 4)
    right = sensing.read_itof(frames, F, 4, readout="differential", noise=known)
    measured = right.depth_m.std()
    # 576 pixels know a deviation to 3 %
    assert right.depth_std_m.mean().item() == pytest.approx(measured.item(), rel=0.12)


def test_an_offset_that_its_amplitude_excludes():
    frames = frames_of(sensing.PixelElectronics(read_noise_e=20.0), sensing.TapDifference(), size=4)
    picture = torch.full((1, 1, 4, 4), 2e4 / 4, dtype=torch.float64)
    picture[..., 1, 1], picture[..., 2, 3] = 0.0, 100.0
    noise = sensing.ItofNoise(read_noise_e=20.0, offset_e=picture)
    found = sensing.read_itof(frames, F, 4, readout="differential", noise=noise).depth_std_m
    wrong = found.isnan().nonzero().tolist()
    assert wrong == [[0, 1, 1], [0, 2, 3]]
    for nothing in ({"offset_e": 0.0}, {"std_e": 0.0}):
        with pytest.raises(UnitError, match=r"\(0, inf\]"):
            sensing.ItofNoise(**nothing)
    with pytest.raises(UnitError, match="every offset_e"):
        sensing.ItofNoise(offset_e=-picture)


@pytest.mark.parametrize("readout", ["single", "two_tap", "differential"])
@pytest.mark.parametrize("known", [{"read_noise_e": 20.0}, {"offset_e": 5e3}, {"std_e": 30.0}], ids=str)
def test_whole_numbers_ask_for_their_electrons(readout, known):
    frames = torch.full((1, 8, 2, 2), 100, dtype=torch.int16)
    steps = 4 if readout == "two_tap" else 8
    with pytest.raises(UnitError, match=r"electrons_per_unit=\.\.\."):
        sensing.read_itof(frames, F, steps, readout=readout, noise=sensing.ItofNoise(**known))
    plain = sensing.read_itof(frames, F, steps, readout=readout)
    assert plain.depth_std_m is None


def test_the_deviation_of_two_taps_is_that_of_their_difference():
    frames = frames_of(sensing.PixelElectronics(read_noise_e=20.0), size=4)
    of_all = (2e4 / 4 + 2 * 20.0**2) ** 0.5
    read = {"frequencies_hz": F, "num_taps": 4}
    taps = sensing.read_itof(frames, **read, readout="two_tap", noise=sensing.ItofNoise(read_noise_e=20.0))
    given = sensing.read_itof(frames, **read, readout="two_tap", noise=sensing.ItofNoise(std_e=of_all))
    apart = frames[:, 0::2] - frames[:, 1::2]
    same = sensing.read_itof(apart, **read, readout="differential", noise=sensing.ItofNoise(std_e=of_all))
    assert torch.equal(given.depth_std_m, same.depth_std_m)
    # sums of 5000 electrons swing by 1.4 %, of which the deviation has half
    torch.testing.assert_close(given.depth_std_m, taps.depth_std_m, rtol=0.04, atol=0)


def test_the_exposures_of_the_numbers():
    """One step of four: a quarter of the light and of background_e, the dark electrons of both taps."""
    camera = two_tap(None, sensing.PixelElectronics(dark_e=7.0), background_e=800.0, contrast=0.5)
    taps = camera.expected(at(100)[0]).flatten()
    torch.testing.assert_close(taps[0::2] + taps[1::2], torch.full((4,), 2e4 / 4 + 800 / 4 + 2 * 7.0).double())


# --------------------------------------------------------------------------------------------------- other units


def test_frames_of_other_machines():
    """Of the other byte order, read only, of strides, and turned round."""
    frames = (100 * torch.rand(1, 4, 2, 3, generator=torch.Generator().manual_seed(0))).to(torch.int16)
    wanted = sensing.read_itof(frames, F, 4).depth_m
    for dtype in (">i2", ">u2", ">f4", ">i4", "<f8"):
        array = frames.numpy().astype(dtype)
        array.flags.writeable = False
        for given in (array, np.ascontiguousarray(array[..., ::-1])[..., ::-1]):
            torch.testing.assert_close(sensing.read_itof(given, F, 4).depth_m.double(), wanted.double())

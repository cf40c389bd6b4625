"""What is refused, by whom, and in which words: one line for each thing that sensing cannot do."""

from __future__ import annotations

import math

import pytest
import torch

from support.sweeps import together
from torchtransient import TimeAxis, sensing
from torchtransient.errors import ArgumentError, GradientError, ShapeError, StorageError, TorchTransientError, UnitError
from torchtransient.sensing.afterpulsing import AfterpulseDelays
from torchtransient.sensing.afterpulsing_spad import _LossyChain
from torchtransient.sensing.counts import AddedCounts, MovedCounts, Moves
from torchtransient.sensing.dead_time.renewal import _check_residual
from torchtransient.sensing.devices import Device
from torchtransient.sensing.draws import sample_multinomial
from torchtransient.sensing.parameters import check_map
from torchtransient.sensing.polarization import demosaic, mosaic_rows
from torchtransient.sensing.responses import Response
from torchtransient.sensing.sensor import RandomSensor, ScoreFunction, Sensor, WrappedDetector

PS = 1e-12
WIDTH = {"bin_width_s": 100 * PS}
AXIS = TimeAxis.from_seconds(0.0, 100 * PS, 6)
LIGHT = torch.full((1, 6, 2, 3), 0.2)
SPADS = [sensing.SynchronousSPAD(7), sensing.SynchronousSPAD(9)]
WHICH = torch.tensor([[0, 1, 1], [1, 0, 0]])


class Bare(Sensor):
    """Nothing is defined."""


class Drawn(RandomSensor):
    """A mean and draws, and nothing of their noise."""

    def expected(self, x):
        return 2 * x

    def sample(self, x, generator=None):
        return 2 * x


class Cut(Sensor):
    """Loses its gradient."""

    def expected(self, x):
        return x.detach()


class Unplaced(Response):
    """No distribution."""

    def __init__(self):
        super().__init__(0.0, False)


def scored(losses, **keywords):
    with ScoreFunction() as score:
        sensing.ShotNoise(grad="score")(LIGHT.clone().requires_grad_())
    return score.surrogate(losses, **keywords)


def camera(**keywords):
    given = {"frequencies_hz": (20e6, 60e6), **keywords}
    return sensing.ItofCorrelation(sensing.sine_code(3), axis=AXIS, **given)


def map_of(rows=2, columns=3):
    return sensing.ItofCalibration(phase_map_rad=torch.full((rows, columns), 0.1))


def described(**parts):
    stages = ({"kind": "SynchronousSPAD", "cycles": 5},)
    return Device(**{"name": "a", "description": "b", "sources": (), "stages": stages, **parts})


REFUSED = {
    "complex map": (lambda: check_map(torch.ones(2, 2, dtype=torch.complex64), "gain", "here"), UnitError,
                    "here: expected gain as real numbers, got torch.complex64"),
    "truth values as a map": (lambda: check_map(torch.ones(2, 2, dtype=torch.bool), "gain", "here"), UnitError,
                              "here: expected gain as real numbers, got torch.bool"),
    "baseline": (lambda: scored(torch.ones(1), baseline="mean"), ArgumentError, "baseline 'leave_one_out' or a number"),
    "no gaussian": (lambda: Drawn(grad="gaussian")(LIGHT), GradientError, "^Drawn: grad='gaussian' is not supported"),
    "no score": (lambda: Drawn(grad="score").log_prob(LIGHT, LIGHT), GradientError,
                 "^Drawn: grad='score' is not supported"),
    "edges of a gate": (lambda: sensing.GatedIntegration([1e-10], 1e-10, AXIS, rise_s=6.1e-9), UnitError,
                        "^GatedIntegration: expected edges in seconds that fit a window of 6e-10 s"),
    "falling edge of a gate": (lambda: sensing.GatedIntegration([1e-10], 1e-10, AXIS, rise_s=1e-10, fall_s=6.1e-9),
                               UnitError, "^GatedIntegration: expected edges in seconds"),
    "no map of sensors": (lambda: sensing.PixelGroups.by_value(torch.ones(3), lambda value: SPADS[0]), ShapeError,
                          r"PixelGroups\.by_value: expected a map"),
    "list of sensors' values": (lambda: sensing.PixelGroups.by_value([[1.0]], lambda value: SPADS[0]), ShapeError,
                                r"PixelGroups\.by_value: expected a map"),
    "gates of other numbers": (
        lambda: sensing.PixelGroups([sensing.GatedIntegration(d, 1e-10, AXIS, rise_s=1e-11)
                                     for d in ([1e-10], [1e-10, 2e-10])], WHICH)(LIGHT),
        ShapeError, "PixelGroups: expected sensors that give equal bins"),
    "likelihood of a blur": (
        lambda: sensing.PixelGroups([sensing.ImpulseResponse(sensing.GaussianResponse(PS), **WIDTH)] * 2, WHICH)
        .log_prob(LIGHT, LIGHT), GradientError, r"PixelGroups\.log_prob: expected random sensors, got ImpulseResponse"),
    "long laws of delays": (
        lambda: sensing.MeasuredDelays(torch.ones(3), 1e-9).kernel(0.0, 3e-9 / (1 << 23), 5), UnitError,
        "^MeasuredDelays: expected delays of at most 8388608 bins, got 838861"),
    "no law of delays": (lambda: sensing.Afterpulsing(0.1, dead_time_s=0.0, delays=3.0, **WIDTH), UnitError,
                         "Afterpulsing: expected delays to be PowerLawDelays"),
    "several probabilities of a law": (
        lambda: sensing.Afterpulsing([0.1], dead_time_s=0.0, delays=sensing.MeasuredDelays(torch.ones(3), 1e-9),
                                     **WIDTH), ShapeError, "expected one probability of delays, got 1"),
    "exponentials of a law": (
        lambda: sensing.Afterpulsing(0.1, dead_time_s=0.0, delays=sensing.MeasuredDelays(torch.ones(3), 1e-9),
                                     **WIDTH).tau_s, UnitError, r"Afterpulsing\.tau_s: expected exponentials"),
    "score of moves of every bin": (
        lambda: Moves(0, torch.ones(2, 6) / 2, "zero").log_prob(torch.ones(2, 1)), GradientError,
        r"MovedCounts: expected shares \(L,\) under grad='score'"),
    "carriers that do not converge": (
        lambda: _LossyChain._checked(torch.ones(2), torch.tensor([0.0, 2e-7])), TorchTransientError,
        "relative residual of 1e-07 of trapped carriers, got 2e-07"),
    "phases that do not converge": (lambda: _check_residual(torch.tensor([1e-10, 2e-9])), TorchTransientError,
                                    "relative residual of 1e-09, got 2e-09"),
    "phases that are no number": (lambda: _check_residual(torch.tensor([math.nan])), TorchTransientError, "got nan"),
    "name of a device": (lambda: described(name=3), StorageError, "expected name as a text, got 3"),
    "description of a device": (lambda: described(description=None), StorageError, "expected description as a text"),
    "source of a device": (lambda: described(sources="page 3"), StorageError, "expected sources as a list"),
    "stages of a device": (lambda: described(stages={"kind": "ShotNoise"}), StorageError, "expected stages as a list"),
    "number as a source": (lambda: described(sources=(3,)), StorageError, "expected sources as texts, got 3"),
    "transpose without gradient": (lambda: sensing.adjoint(Cut(), LIGHT, LIGHT.shape), GradientError,
                                   "adjoint: expected a sensor with gradients, but Cut has none"),
    "knots and values of two shapes": (lambda: sensing.PiecewiseLinearCode(torch.ones(2, 3), torch.ones(2, 4)),
                                       ShapeError, r"expected knots and values \(N, J >= 2\)"),
    "one knot": (lambda: sensing.PiecewiseLinearCode(torch.ones(2, 1), torch.ones(2, 1)), ShapeError, "J >= 2"),
    "knots in one row": (lambda: sensing.PiecewiseLinearCode(torch.arange(3) / 4, torch.ones(3)), ShapeError, "J >= 2"),
    "values above one": (
        lambda: sensing.PiecewiseLinearCode(torch.tensor([[0.1, 0.2]] * 2), torch.tensor([[1.0, -1.0], [0.3, -1.1]])),
        UnitError, r"expected values in \[-1, 1\], got up to 1\.1"),
    "opening of a turn": (lambda: sensing.binary_code(0.1, [[(0.2, 1.2)]] * 2), UnitError,
                          "openings and light of 0 to 1 turn"),
    "opening backwards": (lambda: sensing.binary_code(0.1, [[(0.4, 0.2)]] * 2), UnitError,
                          "openings and light of 0 to 1 turn"),
    "light all the time": (lambda: sensing.binary_code(1.0, [[(0.2, 0.4)]] * 2), UnitError,
                           "openings and light of 0 to 1 turn"),
    "weights of no picture": (lambda: sample_multinomial(3, torch.ones(2, 3)), ShapeError,
                              r"sample_multinomial: expected \(\.\.\., T, H, W\)"),
    "empty kernel": (lambda: sensing.convolve_time(LIGHT, torch.ones(0)), ShapeError,
                     r"convolve_time: expected a kernel \(K,\) with K >= 1, got \(0,\)"),
    "kernel of two dimensions": (lambda: sensing.convolve_time(LIGHT, torch.ones(2, 2)), ShapeError, "convolve_time"),
    "even spread": (lambda: sensing.blur_image(LIGHT, torch.ones(1, 2)), ShapeError, "blur_image: expected a PSF"),
    "high even spread": (lambda: sensing.blur_image(LIGHT, torch.ones(2, 1)), ShapeError, "blur_image: expected a PSF"),
    "flat spread": (lambda: sensing.blur_image(LIGHT, torch.ones(3)), ShapeError, "blur_image: expected a PSF"),
    "small disc": (lambda: sensing.defocus_psf(0.01, oversampling=2), UnitError,
                   "a tenth of a pixel or more, got 0.01"),
    "dark spread": (lambda: sensing.SpatialPSF(torch.zeros(3, 3)), UnitError, "SpatialPSF: expected finite values"),
    "negative spread": (lambda: sensing.SpatialPSF(torch.tensor([[3.0, -1.0, 1.0]])), UnitError, "SpatialPSF"),
    "infinite spread": (lambda: sensing.SpatialPSF(torch.tensor([[3.0, math.inf, 1.0]])), UnitError, "SpatialPSF"),
    "even lens": (lambda: sensing.LensBlur(0.8, size=4), ShapeError, "LensBlur: expected an odd size, got 4"),
    "codes in one row": (lambda: sensing.CodedHistogram(torch.ones(4)), ShapeError, r"codes \(K, T\), got \(4"),
    "codes as a list": (lambda: sensing.CodedHistogram([[1.0]]), ShapeError, r"expected codes \(K, T\), got list"),
    "infinite codes": (lambda: sensing.CodedHistogram(torch.tensor([[1.0, math.inf]])), UnitError, "finite codes"),
    "one measured count": (lambda: sensing.MeasuredResponse(torch.ones(1), PS), ShapeError, r"T >= 2, got \(1,\)"),
    "counts as a list": (lambda: sensing.MeasuredResponse([1.0, 2.0], PS), ShapeError, "T >= 2, got list"),
    "peak in the middle": (lambda: sensing.MeasuredResponse(torch.tensor([0.0, 3.0, 1.0]), PS, align="peak"),
                           ShapeError, "align 'center_of_mass' or 'start', got 'peak'"),
    "even oversampling": (lambda: sensing.ComposedResponse([sensing.UniformResponse(PS)], oversampling=4), ShapeError,
                          "oversampling to be odd and >= 1, got 4"),
    "no oversampling": (lambda: sensing.ComposedResponse([sensing.UniformResponse(PS)], oversampling=-1), ShapeError,
                        "oversampling to be odd and >= 1, got -1"),
    "one share of two tails": (lambda: sensing.TailedResponse(PS, [PS, 2 * PS], [0.1]), ShapeError,
                               "as many fractions as tails_s, got 1 and 2"),
    "no tails": (lambda: sensing.TailedResponse(PS, [], []), ShapeError, "as many fractions as tails_s, got 0 and 0"),
    "shares of more than all": (lambda: sensing.TailedResponse(PS, [PS, 2 * PS], [0.6, 0.5]), UnitError,
                                r"fractions with sum <= 1, got 1\.1"),
    "negative dead time": (lambda: sensing.paralyzable_histogram(LIGHT, -0.5), UnitError, "dead_bins >= 0, got -0.5"),
    "endless dead time": (lambda: sensing.paralyzable_histogram(LIGHT, math.inf), UnitError, "dead_bins >= 0, got inf"),
    "wide jitter of sweeps": (lambda: sensing.SweepJitter(1.5e-9, AXIS)(LIGHT), UnitError,
                              "SweepJitter: expected jitter below the window of 6e-10 s"),
    "codes of no dimension": (lambda: sensing.TDC(torch.tensor(1.0)), ShapeError, r"TDC: expected code_widths \(T,\)"),
    "codes of a list": (lambda: sensing.TDC([1.0, 1.0]), ShapeError, r"TDC: expected code_widths \(T,\)"),
    "no codes": (lambda: sensing.TDC(torch.ones(0)), ShapeError, r"TDC: expected code_widths \(T,\)"),
    "half a sphere and more": (lambda: sensing.Optics(solid_angle_sr=6.3), UnitError,
                               r"solid_angle_sr in \(0, 6\.28319\]"),
    "one angle": (lambda: sensing.linear_analyzers(30.0), ShapeError,
                  "linear_analyzers: expected a list of angles, got 30"),
    "one angle as a tensor": (lambda: sensing.linear_analyzers(torch.tensor(30.0)), ShapeError, "a list of angles"),
    "block of one angle": (lambda: mosaic_rows(30.0), ShapeError, "mosaic_rows: expected rows of angles, got 30"),
    "block of one row": (lambda: mosaic_rows([30.0, 60.0]), ShapeError, "mosaic_rows: expected rows of angles"),
    "raw light as a list": (lambda: demosaic([1.0]), ShapeError, r"demosaic: expected raw as a tensor, got .*1\.0"),
    "transpose of no sensor": (lambda: sensing.adjoint(torch.nn.Identity(), LIGHT, LIGHT.shape), ArgumentError,
                               r"adjoint: expected a sensor of tt\.sensing, got .*Identity"),
    "samples of two lengths": (lambda: sensing.measured_code([[0.0, 1.0, 2.0], [1.0, 2.0]]), ShapeError,
                               "measured_code: expected samples as rows of numbers of one length"),
    "no solid angle": (lambda: sensing.Optics(solid_angle_sr=0.0), UnitError, "solid_angle_sr in"),
}  # fmt: skip


@together("name", REFUSED)
def test_what_is_refused(name):
    call, error, words = REFUSED[name]
    with pytest.raises(error, match=words):
        call()


UNDEFINED = {
    "expected": lambda: Bare()(LIGHT),
    "expected of draws": lambda: RandomSensor()(LIGHT),
    "sample": lambda: RandomSensor().sample(LIGHT),
    "rate": lambda: WrappedDetector(SPADS[0], None).rate(LIGHT),
    "seen": lambda: AfterpulseDelays().seen(1e-9),
    "mean_yet_to_come": lambda: AfterpulseDelays().mean_yet_to_come(torch.ones(2), 1e-9, 1e-9),
    "draw": lambda: AfterpulseDelays().draw(3, 1e-9, None),
    "end_s": lambda: AfterpulseDelays().end_s(),
    "extra": lambda: AddedCounts().extra(LIGHT),
    "trigger": lambda: AddedCounts().trigger(LIGHT, None),
    "share": lambda: AddedCounts().share(),
    "moves": lambda: MovedCounts().moves(LIGHT),
    "cdf": lambda: Unplaced().cdf(torch.ones(2)),
    "support_s": lambda: Unplaced().support_s(),
}


@pytest.mark.parametrize("name", UNDEFINED)
def test_what_a_subclass_has_to_define(name):
    with pytest.raises(NotImplementedError, match=f"has to define {name.split()[0]}"):
        UNDEFINED[name]()


def test_the_state_of_a_camera_of_other_frequencies():
    state = camera(calibration=map_of()).state_dict()
    one = camera(calibration=map_of(), frequencies_hz=20e6)
    with pytest.raises(ShapeError, match=r"load_state_dict: expected phases_rad \(1, H, W\), got \(2, 2, 3\)"):
        one.load_state_dict(state)
    two = camera(calibration=map_of(3, 4))
    two.load_state_dict(state)
    assert two.phases_rad.shape == (2, 2, 3)
    with pytest.raises(ShapeError, match="phases_rad"):
        camera().load_state_dict({**camera().state_dict(), "phases_rad": torch.ones(2)})


def test_limits_that_are_reached_are_taken():
    """What is refused begins behind them."""
    assert sensing.Optics(solid_angle_sr=2 * math.pi).etendue_m2_sr > 0
    sensing.GatedIntegration([1e-10], 1e-10, AXIS, rise_s=6e-9, fall_s=5.9e-9)
    assert sensing.ComposedResponse([sensing.UniformResponse(PS)], oversampling=1).oversampling == 1
    assert not sensing.TailedResponse(PS, [PS, 2 * PS], [0.6, 0.4]).has_core
    assert torch.equal(sensing.paralyzable_histogram(LIGHT, 0.0), LIGHT)
    assert sensing.defocus_psf(0.5).tolist() == [[1.0]]
    for half in (torch.tensor([0.2]), torch.tensor([1e-7])):
        _LossyChain._checked(half, half * 0 + 1e-7)
    _check_residual(torch.tensor([1e-9], dtype=torch.float64))

"""What sensors are given: gradients are kept or refused, arrays are taken, half precision is measured in single."""

from __future__ import annotations

import copy
import inspect
import re
import warnings
from functools import partial

import pytest
import torch
from torch import nn

from support.refused import complaint
from support.sensing.arguments import CALLS, COUNTS, DECIDE, LIGHT, OTHERS, PHASOR, RESPONSE, STOKES
from support.sweeps import together
from torchtransient import sensing
from torchtransient.axes import TimeAxis
from torchtransient.errors import GradientError, ShapeError, TorchTransientError, UnitError

every_call = together("name", sorted(CALLS))


def tensors_of(value):
    if isinstance(value, torch.Tensor):
        return [value]
    if isinstance(value, (tuple, list)):
        return [t for part in value for t in tensors_of(part)]
    if hasattr(value, "__dataclass_fields__"):
        return [t for field in value.__dataclass_fields__ for t in tensors_of(getattr(value, field))]
    return []


def test_everything_public_is_swept():
    public = {n for n in dir(sensing) if not n.startswith("_") and callable(getattr(sensing, n))}
    assert public == set(CALLS) | OTHERS
    for name, (numbers, rest) in CALLS.items():
        for argument in inspect.signature(getattr(sensing, name)).parameters.values():
            said = str(argument.annotation)
            if "float" in said or "Tensor" in said or "Frequencies" in said:
                known = argument.name in numbers or argument.name in rest or (name, argument.name) in DECIDE
                assert known or argument.name in ("solid_angle_sr",), (name, argument.name)


def has_kept(result, leaf):
    """Whether a gradient arrives at the leaf, or the module learns it."""
    if isinstance(result, nn.Module):
        return any(p is leaf for p in result.parameters())
    for value in tensors_of(result):
        if value is leaf:
            return True
        if value.requires_grad:
            (found,) = torch.autograd.grad(value.abs().sum(), leaf, allow_unused=True, retain_graph=True)
            if found is not None:
                return True
    return False


@every_call
def test_no_gradient_is_cut_off_in_silence(name):
    call, (numbers, rest) = getattr(sensing, name), CALLS[name]
    for argument, value in numbers.items():
        leaf = nn.Parameter(value.clone())
        others = {k: v for k, v in numbers.items() if k != argument}
        try:
            result = call(**others, **rest, **{argument: leaf})
        except GradientError as error:
            refused = "without a gradient" in str(error)
        else:
            refused = False
        assert refused or has_kept(result, leaf) or (name, argument) in DECIDE, argument


def halved(numbers, dtype):
    """Arguments in half precision, where that can hold them: no picoseconds, no hertz."""
    small = {k: v for k, v in numbers.items() if v.ndim and v.is_floating_point() and 1e-3 < v.abs().max() < 6e4}
    return {k: v.to(dtype) for k, v in small.items() if k != "frequencies_hz"}


# computed in single and handed back in the dtype of the light, which they do not make larger
KEEP_HALF = ("blur_image", "convolve_time", "straight_through")


@pytest.mark.slow
@every_call
@together("dtype", [torch.float16, torch.bfloat16])
def test_functions_measure_half_precision_in_single(name, dtype):
    call, (numbers, rest) = getattr(sensing, name), CALLS[name]
    halves = halved(numbers, dtype)
    if inspect.isclass(call) or not halves:
        return
    others = {k: v for k, v in numbers.items() if k not in halves}
    torch.manual_seed(0)
    wanted = tensors_of(call(**{k: v.float() for k, v in halves.items()}, **others, **rest))
    torch.manual_seed(0)
    for found, exact in zip(tensors_of(call(**halves, **others, **rest)), wanted, strict=True):
        assert torch.equal(found, exact.to(dtype) if name in KEEP_HALF else exact)
        assert found.dtype == (dtype if name in KEEP_HALF else exact.dtype)


def test_large_numbers_in_half_precision():
    """Squares, sums and rates beyond 65504, of numbers below it."""
    big = torch.tensor([3e4], dtype=torch.float16)
    noise = sensing.phase_noise_rad(big, 2 * big, 4, read_noise_e=300.0)
    assert torch.equal(noise, sensing.phase_noise_rad(big.float(), 2 * big.float(), 4, read_noise_e=300.0))
    albedo = torch.full((2, 2), 0.5, dtype=torch.float16)
    sun = {"spectral_irradiance_w_m2_nm": 1.3, "filter_bandwidth_m": 1e-8, "wavelength_m": 7e-7}
    rate = sensing.ambient_photon_rate(sensing.Optics(f_number=2.0), albedo, **sun)
    assert rate.dtype == torch.float32
    # one over 2^22: the products are those of float32
    exact = sensing.ambient_photon_rate(sensing.Optics(f_number=2.0), 0.5, **sun)
    assert rate[0, 0].item() == pytest.approx(exact, rel=1e-6) and exact > 65504
    stokes = torch.tensor([3e4, 6e4, 6e4, 0.0], dtype=torch.float16).reshape(4, 1, 1, 1, 1)
    assert sensing.unphysical_part(stokes).item() == pytest.approx(6e4 * 2**0.5 - 3e4, rel=1e-3)
    assert torch.isfinite(sensing.project_physical(stokes)).all()


# what tensors of maps and frames go into, besides constructors
TAKE_ARRAYS = ("ambient_photon_rate", "crlb", "measured_code", "read_itof", "return_rates")


@every_call
def test_arrays_are_taken_where_tensors_are(name):
    """Of the byte order of files from other machines, too."""
    call, (numbers, rest) = getattr(sensing, name), CALLS[name]
    if not inspect.isclass(call) and name not in TAKE_ARRAYS:
        return
    arrays = {k: v.numpy().astype(">f8") if v.ndim else v for k, v in numbers.items()}
    found, wanted = call(**arrays, **rest), call(**numbers, **rest)
    if isinstance(found, nn.Module):
        for a, b in zip(found.state_dict().values(), wanted.state_dict().values(), strict=True):
            assert torch.equal(a, b)
    for a, b in zip(tensors_of(found), tensors_of(wanted), strict=True):
        assert torch.equal(a, b)


MODULES = [n for n in sorted(CALLS) if inspect.isclass(m := getattr(sensing, n)) and issubclass(m, nn.Module)]
# A period is its number of bins, and a floor is taken off the counts.
ANOTHER_WORD = {("FreeRunningSPAD", "period_s"), ("MeasuredDelays", "floor"), ("MeasuredResponse", "floor")}


@together("name", MODULES)
def test_a_repr_shows_the_numbers(name):
    """Modules without storage, of the device "meta", have none to show."""
    numbers, rest = CALLS[name]
    module = getattr(sensing, name)(**numbers, **rest)
    text = repr(module)
    for argument, value in numbers.items():
        if value.ndim == 0 and (name, argument) not in ANOTHER_WORD:
            assert re.search(rf"=\(?{re.escape(f'{float(value):g}')}[,)\n]", text), f"{argument} in {text}"
    assert repr(copy.deepcopy(module).to("meta")).startswith(name)


def test_a_repr_without_memory():
    spad = sensing.FreeRunningSPAD(10, 3e-9, bin_width_s=1e-9, learnable=True).to("meta")
    assert "cycles=10" in repr(spad)


def test_buffers_are_learnt_by_functional_call():
    """The way that the error names: a gate that a network has made."""
    spad = sensing.SynchronousSPAD(10, gate=torch.ones(12))
    gate = torch.full((12,), 0.5, dtype=torch.float64, requires_grad=True)
    with pytest.raises(GradientError, match="functional_call"):
        sensing.SynchronousSPAD(10, gate=gate)
    torch.func.functional_call(spad, {"gate": gate}, (torch.rand(1, 12, 1, 1),)).sum().backward()
    assert bool((gate.grad != 0).all())


@pytest.mark.parametrize("transform", [torch.func.jacfwd, torch.func.jacrev], ids=lambda t: t.__name__)
def test_transforms_of_what_is_cut_off(transform):
    """Their tensors require no gradient that can be seen in forward mode."""
    x = torch.rand(1, 12, 2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def measured(delay_s):
        return sensing.PixelSkew(delay_s, bin_width_s=1e-10)(x).square().sum()

    with pytest.raises(GradientError, match="PixelSkew: expected delay_s"):
        transform(measured)(torch.full((2, 3), 3e-11, dtype=torch.float64))
    with pytest.raises(GradientError, match="dead_time_s"):
        transform(lambda t: sensing.free_running_rate(torch.ones(1), t))(torch.tensor(1e-8))

    def shifted(delay):
        return sensing.shift_time(x, delay).square().sum()

    assert bool((transform(shifted)(torch.full((2, 3), 0.3, dtype=torch.float64)) != 0).all())


def test_parameters_that_are_kept_may_be_used_on_the_way():
    """A sensor of one's own that keeps what it makes of an argument has not cut it off; one that copies it has."""

    class Doubled(sensing.Sensor):
        def __init__(self, gain, keep=True):
            super().__init__()
            self.gain = 2 * gain if keep else 2 * gain.detach()

        def expected(self, x):
            return self.gain * x

    gain = nn.Parameter(torch.tensor(1.5))
    Doubled(gain).expected(torch.ones(1, 1, 1, 1)).sum().backward()
    assert gain.grad == 2
    with pytest.raises(GradientError, match="Doubled: expected gain"):
        Doubled(gain, keep=False)


@pytest.mark.parametrize("name", ["phase_offset_rad", "phase_map_rad", "depth_map_m"])
def test_calibrations_are_learnt(name):
    """Through the taps of a sine code and back through the reading; as the buffer that they are when they are not."""
    axis = TimeAxis.from_seconds(0.0, 1e-9, 12)
    start = torch.full(() if name == "phase_offset_rad" else (2, 3), 0.1, dtype=torch.float64)
    light = torch.rand(1, 12, 2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def taps(value):
        known = sensing.ItofCalibration(**{name: value})
        return sensing.ItofCorrelation(sensing.sine_code(4), (20e6, 60e6), axis, calibration=known)

    learnt = nn.Parameter(start.clone())
    camera = taps(learnt)
    assert [p is learnt for p in camera.parameters()] == [True]
    torch.testing.assert_close(camera(light), taps(start)(light), rtol=1e-12, atol=1e-12)

    def through(value):
        return torch.func.functional_call(camera, {name: value}, (light,))

    assert torch.autograd.gradcheck(through, (start.clone().requires_grad_(),))
    optimizer = torch.optim.SGD(camera.parameters(), lr=0.0)
    for _ in range(2):  # no graph is left over from the step before
        optimizer.zero_grad()
        camera(light)[:, 1].sum().backward()
        optimizer.step()
        assert bool((learnt.grad != 0).all())
    frames = camera(light).detach()
    reading = sensing.read_itof(frames, (20e6, 60e6), 4, calibration=sensing.ItofCalibration(**{name: learnt}))
    learnt.grad = None
    reading.depth_m.sum().backward()
    assert bool((learnt.grad < 0).all())
    known = sensing.ItofCalibration(**{name: learnt})
    with pytest.raises(GradientError, match="sine code"):
        sensing.ItofCorrelation(sensing.square_code(4), 20e6, axis, calibration=known)


def wrong_for(value):
    """What may stand in the place of a tensor, or of a number, by mistake."""
    whole = value.real.round().long() if value.is_complex() else value.round().long()
    yield from (None, object(), ["a"], "x", 2**70, whole, whole > 0, value.to_sparse())
    yield value.real if value.is_complex() else value + 1j
    if value.ndim:
        yield value[..., :0, :, :] if value.ndim >= 4 else value[:0]


@pytest.mark.slow
@together("name", sorted(CALLS))
def test_what_is_no_tensor_of_numbers_is_said_in_one_sentence(name):
    call, (numbers, rest) = getattr(sensing, name), CALLS[name]
    wrong = []
    for argument, value in numbers.items():
        for given in wrong_for(value):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                attempt = partial(call, **{**numbers, argument: given}, **rest)
                taken, said = complaint(attempt, TorchTransientError, given)
            if taken and (isinstance(given, (str, list)) or type(given) is object):
                said = f"{given!r} is taken"
            wrong += [f"{argument}: {said}"] if said else []
    assert not wrong, "; ".join(wrong)


@together(
    "make, error, said",
    [
        (lambda: sensing.Compose(0), TorchTransientError, "Compose: expected several sensors, got 0"),
        (lambda: sensing.ComposedResponse(0), ShapeError, "ComposedResponse: expected several responses"),
        (lambda: sensing.ComposedResponse([RESPONSE], oversampling=2**70), ShapeError, "oversampling to be odd"),
        (lambda: sensing.PixelGroups(0, 0), TorchTransientError, "PixelGroups: expected several sensors, got 0"),
        (lambda: sensing.fixed_pattern(-1, 2), UnitError, r"fixed_pattern: expected shape in \[0, inf\]"),
        (lambda: sensing.fixed_pattern((2**40, 2**40), 2), UnitError, "at most 2\\^63 - 1 numbers"),
        (lambda: sensing.sine_code(2**70), ShapeError, "expected at most 16777216 taps"),
        (lambda: sensing.square_code(2**70), ShapeError, "expected at most 16777216 taps"),
        (lambda: sensing.fourier_codes(2**70, 2), UnitError, "num_bins to be a whole number of at most 16777216"),
        (lambda: sensing.FourierCode(4, {2**70: (0.5, 0.1)}), UnitError, "whole number of at most 16777216"),
        (lambda: sensing.FourierCode(4, 5), TorchTransientError, "FourierCode: expected a dictionary"),
        (lambda: sensing.FourierCode(4, {1: (0.5,)}), ShapeError, r"as \(amplitude, phase in radians\)"),
        (lambda: sensing.defocus_psf(2**70), UnitError, "defocus_psf: expected a disc of at most 32768 points"),
        (lambda: sensing.hamiltonian_code(torch.ones(3)), ShapeError, "expected 3 or 4 taps"),
        (lambda: sensing.demosaic(torch.ones(1, 1, 4, 4), 2), ShapeError, "demosaic: block"),
        (lambda: sensing.project_physical(STOKES, None), ShapeError, "stokes: dim: expected a whole number"),
        (lambda: sensing.poisson(LIGHT, 5), TorchTransientError, "poisson: expected generator to be a torch.Generator"),
        (lambda: sensing.poisson(1j * LIGHT), UnitError, "poisson: expected mean as real numbers, got torch"),
        (lambda: sensing.phase_of(LIGHT), UnitError, "phase_of: expected phasor as complex numbers, got torch.float64"),
        (lambda: sensing.background_per_bin(LIGHT[:, :0]), ShapeError, "one bin or more along time"),
        (lambda: sensing.offset_of(LIGHT, 4, readout=torch.ones(2)), TorchTransientError, "expected readout to be one"),
    ],
)
def test_what_sensors_do_not_take(make, error, said):
    with pytest.raises(error, match=said):
        make()


def test_whole_numbers_and_truth_values_are_numbers():
    """Of the default dtype; histograms that are measured with all their digits."""
    whole, some = COUNTS.long(), COUNTS > 5
    for function in (sensing.poisson_log_prob, sensing.wrapped_difference):
        for given in (whole, some):
            torch.testing.assert_close(function(given, given), function(given.float(), given.float()), rtol=0, atol=0)
    exact = sensing.frames_to_rate(whole.float(), 100)
    torch.testing.assert_close(sensing.frames_to_rate(whole, 100), exact, rtol=0, atol=0)
    stokes = torch.tensor([3, 2, 2, 2]).reshape(4, 1, 1, 1, 1)
    torch.testing.assert_close(sensing.project_physical(stokes), sensing.project_physical(stokes.float()))
    assert sensing.poisson(some, torch.Generator().manual_seed(0)).dtype == torch.float32
    many = torch.tensor([2**24 + 1, 2**25 + 1])
    found = sensing.resample_counts(many, 1.0, torch.tensor([0.0, 1.0, 2.0]).double())
    assert found.tolist() == many.tolist()
    assert sensing.amplitude_of(PHASOR).dtype == torch.float64

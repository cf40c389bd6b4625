"""What sensors are given: gradients are kept or refused, arrays are taken, half precision is measured in single."""

from __future__ import annotations

import inspect

import pytest
import torch
from torch import nn

from support.sensing.arguments import CALLS, DECIDE, OTHERS
from support.sweeps import together
from torchtransient import sensing
from torchtransient.axes import TimeAxis
from torchtransient.errors import GradientError

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

    class Summed(sensing.Sensor):
        def __init__(self, *gains, offset=0.0):
            super().__init__()
            self.first, self.offset = gains[0], offset

    with pytest.raises(GradientError, match="Summed: expected argument 1"):
        Summed(gain, gain.square())
    with pytest.raises(GradientError, match="Summed: expected argument 1"):
        Summed(gain, gain.square(), offset=1.0)


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

"""One walk of a chain for its checks, means and draws: rows in rows, pixels of several kinds, sensors around others."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from support.marks import long
from support.sweeps import together
from torchtransient import TimeAxis, sensing
from torchtransient.errors import ArgumentError, GradientError, UnitError
from torchtransient.sensing import Compose, DetectionJitter, GaussianResponse, PixelGroups, SynchronousSPAD

PS = 1e-12
BINS = 16
AXIS = TimeAxis.from_seconds(0.0, 100 * PS, BINS)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def light(batch=1, scale=0.05):
    return scale * torch.rand(1, 1, BINS, 1, 2, dtype=torch.float64, generator=generator()).expand(batch, 1, BINS, 1, 2)


def jitter(**given):
    return DetectionJitter(GaussianResponse(150 * PS), AXIS, **given)


def spad(cycles=400):
    return SynchronousSPAD(cycles)


def pulsing():
    return sensing.AfterpulsingSPAD(
        SynchronousSPAD(400, dead_time_s=3e-10, axis=AXIS), sensing.Afterpulsing(0.05, 1e-9, 3e-10, axis=AXIS)
    )


def halves(make):
    """Two sensors of one kind for the two pixels."""
    return PixelGroups([make(), make()], torch.tensor([[0, 1]]))


# every way to put sensors into one another, and the same sensors without it
NESTED = {
    "Sequential": (lambda: Compose([nn.Sequential(spad(), jitter())]), lambda: Compose([spad(), jitter()])),
    "groups of sensors": (lambda: halves(spad), spad),
    "groups of chains": (lambda: halves(lambda: Compose([spad(), jitter()])), lambda: Compose([spad(), jitter()])),
    "groups in a chain": (
        lambda: Compose([nn.Sequential(halves(lambda: Compose([nn.Sequential(spad())]))), jitter()]),
        lambda: Compose([spad(), jitter()]),
    ),
    "groups of wrappers": (lambda: Compose([halves(pulsing)]), pulsing),
    "groups of macro-pixels": (
        lambda: halves(lambda: sensing.MacroPixel(pulsing(), 3)),
        lambda: sensing.MacroPixel(pulsing(), 3),
    ),
    "groups that add": (
        lambda: Compose([spad(), halves(lambda: sensing.Afterpulsing(0.05, 1e-9, 3e-10, axis=AXIS))]),
        lambda: Compose([spad(), sensing.Afterpulsing(0.05, 1e-9, 3e-10, axis=AXIS)]),
    ),
    "groups that move": (
        lambda: Compose([spad(), halves(lambda: sensing.DetectionSkew(130 * PS, AXIS)), nn.Sequential(jitter())]),
        lambda: Compose([spad(), sensing.DetectionSkew(130 * PS, AXIS), jitter()]),
    ),
}


def spread(y):
    """Variances of the total and of the difference of two bins, (2, 2): of independent bins they would be others."""
    return torch.stack([y.sum(2).var(0), (y[:, :, 4] - y[:, :, 5]).var(0)]).reshape(2, 2)


@pytest.mark.parametrize("name", long(NESTED, [*NESTED][1::3]))
def test_a_nested_sensor_is_the_sensor(name):
    """The same mean, whole draws of the same variance, and normal surrogates with the covariance between bins."""
    number, (nested, plain) = 250, NESTED[name]
    a, b, x = nested(), plain(), light(number)
    torch.testing.assert_close(a.expected(x[:2]), b.expected(x[:2]))
    drawn = a.sample(x, generator(1))
    assert torch.equal(drawn, drawn.round()) and not torch.equal(drawn[0], drawn[1])
    wanted = spread(b.sample(x, generator(2)))
    close = 6 * (2 * 2 / number) ** 0.5  # six standard errors of a ratio of variances
    surrogate = a.gaussian(x, generator(3))
    assert not torch.equal(surrogate, surrogate.round())
    for found in (drawn, surrogate):
        torch.testing.assert_close(spread(found), wanted, rtol=close, atol=0.05)


@pytest.mark.parametrize("nested, plain", NESTED.values(), ids=NESTED)
def test_variances_are_right_or_refused(nested, plain):
    a, b, x = nested(), plain(), light()
    try:
        wanted = b.variance(x)
    except GradientError:
        with pytest.raises(GradientError):
            a.variance(x)
    else:
        torch.testing.assert_close(a.variance(x), wanted)


def test_probability_in_rows_and_groups():
    x = light()
    for a, b in (NESTED["Sequential"], NESTED["groups of chains"], NESTED["groups of sensors"]):
        counts = b().sample(x, generator())
        torch.testing.assert_close(a().log_prob(counts, x), b().log_prob(counts, x))


class Foreign(nn.Module):
    def __init__(self, inner):
        super().__init__()
        self.inner = inner

    def forward(self, x):
        return self.inner(x)


class Half(sensing.Sensor):
    """A plug-in around a detector that forgot its draws."""

    def __init__(self):
        super().__init__()
        self.inner = spad()

    def expected(self, x):
        return self.inner.expected(x)


@pytest.mark.parametrize("make", [lambda: Foreign(spad()), Half, lambda: Foreign(Compose([spad()]))])
@pytest.mark.parametrize("put", [lambda s: Compose([s]), lambda s: Compose([nn.Sequential(nn.Identity(), s)])])
def test_what_cannot_be_drawn_is_refused(make, put):
    with pytest.raises(ArgumentError, match=r"can be drawn, got stage '.*SynchronousSPAD inside.*Give its parts"):
        put(make())
    with pytest.raises(ArgumentError, match=r"PixelGroups: expected .*(can be drawn|list of sensors)"):
        PixelGroups([make()], torch.zeros(1, 2))
    assert isinstance(put(Foreign(nn.Identity())), Compose)


def test_a_stage_that_stands_twice():
    blur = sensing.LensBlur(1.5, "replicate")
    x = torch.rand(1, 4, 5, 5, dtype=torch.float64, generator=generator())
    for chain in (Compose([blur, blur]), Compose([nn.Sequential(blur, blur)]), Compose([nn.ModuleList([blur, blur])])):
        torch.testing.assert_close(chain.expected(x), blur.expected(blur.expected(x)))


# ------------------------------------------------------------------------------------------------------- orders


def budget(**given):
    optics = sensing.Optics(f_number=2.0)
    common = {"pulse_energy_j": 1e-10, "wavelength_m": 9e-7, "repetition_rate_hz": 1e6, "cycles": 400, "axis": AXIS}
    return sensing.PhotonBudget(optics, **{"ambient_rate_hz": 1e6, **common, **given})


def open_response():
    return sensing.ImpulseResponse(GaussianResponse(150 * PS), AXIS)


WHICH = torch.tensor([[0, 1]])
LEARNT = {"ambient_rate_hz": nn.Parameter(torch.zeros(1, 1))}

REFUSED = {
    "chain in a group": (
        lambda: [budget(), PixelGroups([Compose([spad(), jitter()]), Compose([open_response(), spad()])], WHICH)],
        "boundary='zero'",
    ),
    "background in a group": (
        lambda: [PixelGroups([budget(ambient_rate_hz=0.0), budget()], WHICH), open_response(), spad()],
        "boundary='zero'",
    ),
    "learnt background": (lambda: [budget(**LEARNT), open_response(), spad()], "boundary='zero'"),
    "cycles in a group": (lambda: [budget(), halves(lambda: Compose([spad(399)]))], "one number of cycles"),
    "quantity in a group": (lambda: [budget(), halves(lambda: Compose([jitter()]))], "Put the detector between"),
    "jitter of rates": (lambda: [budget(), jitter(), spad()], "acts on detections. Take an ImpulseResponse"),
    "skew of counts": (lambda: [spad(), sensing.PixelSkew(5 * PS, AXIS)], "average counts.*DetectionSkew"),
    "spot of counts": (lambda: [spad(), nn.Sequential(sensing.SpatialPSF(torch.ones(3, 3)))], "average counts"),
    "sweep of counts": (lambda: [spad(), sensing.SweepJitter(9 * PS, AXIS)], "average counts"),
    "rates of counts": (
        lambda: [spad(), sensing.TDC(torch.ones(BINS), acts_on="rates")],
        "average counts.*acts_on='detections'",
    ),
    "response of shot noise": (lambda: [sensing.ShotNoise(), open_response()], "average counts"),
    "codes of rates": (lambda: [budget(), sensing.TDC(torch.ones(BINS), dither=True)], "Put the detector between"),
    "jitter of codes": (lambda: [spad(), sensing.TDC(torch.ones(BINS)), jitter()], "in front of TDC"),
    "afterpulses of codes": (
        lambda: [spad(), sensing.TDC(torch.ones(BINS)), sensing.Afterpulsing(0.1, 1e-9, 1e-10, axis=AXIS)],
        "in front of TDC",
    ),
    "afterpulses twice": (
        lambda: [halves(lambda: sensing.MacroPixel(pulsing(), 2)), sensing.Afterpulsing(0.05, 1e-9, 3e-10, axis=AXIS)],
        "afterpulses of its own",
    ),
    "codes of another number": (lambda: [budget(), spad(), sensing.TDC(torch.ones(64))], "16 bins .*64 bins"),
    "axis in a group": (
        lambda: [budget(), halves(spad), halves(lambda: DetectionJitter(GaussianResponse(9 * PS), bin_width_s=1e-9))],
        "one time axis",
    ),
}


@together("stages, words", REFUSED.values())
def test_orders_that_are_refused(stages, words):
    with pytest.raises(UnitError, match=words):
        Compose(stages())


def test_orders_that_stay_right():
    frozen = budget(ambient_rate_hz=nn.Parameter(torch.zeros(1, 1), requires_grad=False))
    for stages in (
        [frozen, open_response(), spad()],
        [open_response(), budget(**LEARNT), spad(), jitter(), sensing.TDC(torch.ones(BINS))],
        [budget(), halves(lambda: Compose([spad(), jitter()])), sensing.TDC(torch.ones(BINS)), sensing.Crosstalk(0.01)],
        [sensing.PixelElectronics(excess_noise=1.5), sensing.LensBlur(1.0)],  # charge of a tube, spread by its phosphor
        [sensing.PixelSkew(5 * PS, AXIS), sensing.LensBlur(1.0), spad()],
    ):
        assert Compose(stages).stages


def test_a_background_that_is_loaded():
    """Dark counts of a state, behind which an open response would starve them."""
    for name, value in (("dark_count_rate_hz", 100.0), ("ambient_rate_hz", nn.Parameter(torch.full((1, 1), 1e6)))):
        plain = nn.Parameter(torch.zeros(1, 1), requires_grad=False) if isinstance(value, nn.Parameter) else 0.0
        chain = Compose([budget(**{"ambient_rate_hz": 0.0, name: plain}), open_response(), spad()])
        other = Compose([open_response(), budget(**{"ambient_rate_hz": 0.0, name: value}), spad()])
        state = chain.state_dict()
        chain.load_state_dict(state)
        state[f"stages.0.{name}"] = other.state_dict()[f"stages.1.{name}"]
        with pytest.raises(UnitError, match="boundary='zero'"):
            chain.load_state_dict(state)


def test_what_a_chain_takes_and_gives():
    chain = Compose([open_response(), spad(), jitter()])
    assert (chain.takes, chain.gives) == (("rate",), "counts")
    assert (Compose([open_response()]).gives, Compose([nn.Identity()]).gives) == ("the same", None)
    assert Compose([nn.Identity(), spad()]).takes == ()

"""Losses of results in place of tensors: renders, captures, reconstructions."""

import dataclasses
import functools
from types import SimpleNamespace

import pytest
import torch

from support.loss_cases import AXIS, BAND, BINS, CASES
from support.sweeps import together
from torchtransient import Chirps, FrequencyAxis, RateAxis, TimeAxis, losses
from torchtransient.errors import ArgumentError, ShapeError, UnitError

# The attribute that a loss reads, by the argument that is a pair of results.
READS = {
    losses.phasor_loss: "phasor",
    **dict.fromkeys((losses.depth_loss, losses.scale_invariant_depth_loss), "depth_m"),
    losses.ssim_loss: "steady",
    **dict.fromkeys((losses.projection_ssim_loss, losses.total_variation), "values"),
}
every = pytest.mark.parametrize("case", CASES, ids=str)


def attribute_of(case):
    return READS.get(case.function, "transient")


def result(tensor, attribute="transient", axis=AXIS, **more):
    """What a renderer returns, as far as a loss may know: one measure, None for the others."""
    measures = {"transient": None, "phasor": None, "gated": None, "steady": None, attribute: tensor}
    return SimpleNamespace(**measures, **{"axis": axis, "frequencies": None, "gates": None, **more})


def own(case, tensor, attribute):
    """Only what such a result has: the axis of a transient."""
    if attribute in ("depth_m", "values"):
        return SimpleNamespace(**{attribute: tensor})
    return result(tensor, attribute, axis=AXIS if attribute == "transient" else None)


def given(case, x, y):
    """The same arguments as results, each alone and both."""
    attribute = attribute_of(case)
    first = "values" if case.function is losses.measurement_consistency else attribute
    a, b = own(case, x, first), own(case, y, attribute)
    return [(a, b)] if not case.pair or case.second is not None else [(a, b), (a, y), (x, b)]


def bare(case):
    """Without the options that results bring."""
    known = {name: value for name, value in case.options.items() if name not in ("bin_width_opl", "axis")}
    return dataclasses.replace(case, options=known, second=None if case.second is None else halved(case))


def halved(case):
    """A second render of a result is a result."""

    def second(x):
        attribute = attribute_of(case)
        return x / 2 if isinstance(x, torch.Tensor) else own(case, getattr(x, attribute) / 2, attribute)

    return second


@every
def test_results_are_their_tensors(case):
    x, y = case.tensors()
    mask = torch.rand(y.shape, generator=torch.Generator().manual_seed(9)) < 0.6
    for a, b in given(case, x, y):
        taken = bare(case)
        for reduction in ("mean", "none"):
            wanted = case(x, y, mask, reduction)
            torch.testing.assert_close(taken(a, b, mask, reduction), wanted, rtol=0, atol=0)
            torch.testing.assert_close(taken.as_module(a, b, mask, reduction), wanted, rtol=0, atol=0)
    leaf = x.clone().requires_grad_()
    bare(case)(*given(case, leaf, y)[0], reduction="sum").backward()
    other = x.clone().requires_grad_()
    case(other, y, reduction="sum").backward()
    torch.testing.assert_close(leaf.grad, other.grad, rtol=0, atol=0)


@every
def test_results_without_what_is_compared(case):
    x, _ = case.tensors()
    attribute = attribute_of(case)
    wrong = "steady" if attribute != "steady" else "transient"
    empty = own(case, None, attribute) if attribute in ("depth_m", "values") else result(x, wrong)
    with pytest.raises(ShapeError, match=rf"a result with .*{attribute}.*, got SimpleNamespace with") as caught:
        bare(case)(x if case.pair else empty, empty)
    assert str(caught.value).startswith(case.function.__name__ + ":")


def two_records(case):
    """Whether both results have an axis: a volume has none."""
    return attribute_of(case) == "transient" and case.pair and case.function is not losses.measurement_consistency


def test_a_volume_has_no_axis():
    """Beside a measurement, whose `dim` is taken; a record in the place of a volume is refused."""
    x, y = torch.rand(1, BINS, 3, 3), torch.rand(1, BINS, 3, 3)
    loss = functools.partial(losses.measurement_consistency, operator=lambda v: 2 * v, scale_invariant=True)
    scan = SimpleNamespace(shape=(3, 3))
    torch.testing.assert_close(loss(own(None, x, "values"), result(y, scan=scan)), loss(x, y, dim=-3))
    listed = x.flatten(2), y.flatten(2)
    found = loss(own(None, listed[0], "values"), result(listed[1], scan=SimpleNamespace(shape=(9,))))
    torch.testing.assert_close(found, loss(*listed, dim=-2))
    with pytest.raises(ShapeError, match="expected volume to be a tensor or a result with values"):
        loss(result(x), result(y))


@together("case", [case for case in CASES if two_records(case)])
def test_results_on_two_axes(case):
    """A bin of another place, not one of another rounding."""
    x, y = case.tensors()
    other = TimeAxis(AXIS.start_opl + 0.5 * AXIS.bin_width_opl, AXIS.bin_width_opl, BINS)
    a = own(case, x, "transient")
    with pytest.raises(UnitError, match="results on one axis") as caught:
        bare(case)(a, result(y, axis=other))
    assert str(caught.value).startswith(case.function.__name__ + ":")


def test_rates_and_beats_of_a_film():
    """Light over the rates of path lengths and spectra of beats, which losses element by element compare."""
    x, y = torch.rand(2, 1, 4, BINS, 2, 2)
    for name in ("rates", "beats"):
        found = losses.squared_loss(result(x, name), result(y, name))
        torch.testing.assert_close(found, losses.squared_loss(x, y), rtol=0, atol=0)
        with pytest.raises(UnitError, match="results on one axis"):
            losses.squared_loss(result(x, name), result(y, name, TimeAxis(0.0, 1.0, BINS)))
    others = {
        "rates": [{"rate_axis": RateAxis(start, 0.5, 4)} for start in (-1.0, -2.0)],
        "beats": [{"chirps": Chirps(1e9, duration, 1550e-9)} for duration in (1e-5, 2e-5)],
    }
    for name, (one, other) in others.items():
        losses.squared_loss(result(x, name, **one), result(y, name, **one))
        with pytest.raises(UnitError, match="results on one axis"):
            losses.squared_loss(result(x, name, **one), result(y, name, **other))


def test_distances_between_results_over_rates():
    """Along the rates, in m/s; along the arrivals, in metres, if that is asked for. Light that lies elsewhere by k bins
    is k widths away.
    """
    rate_axis = RateAxis(-2.0, 0.5, 6)
    x = torch.zeros(1, 6, BINS, 2, 2)
    x[:, 1, 2] = 1.0
    y = x.roll(3, 1).roll(1, 2)
    a, b = (result(t, "rates", rate_axis=rate_axis) for t in (x, y))
    spectra = [result(t.sum(2, keepdim=True).expand_as(x) / BINS, "rates", rate_axis=rate_axis) for t in (x, y)]
    assert float(losses.wasserstein_loss(*spectra)) == pytest.approx(1.5)
    found = losses.wasserstein_loss(a, b, dim=-3, reduction="none")
    torch.testing.assert_close(found, losses.wasserstein_loss(x, y, AXIS.bin_width_opl, dim=-3, reduction="none"))
    for dim in (None, 1):
        torch.testing.assert_close(losses.cumulative_loss(a, y, dim=dim), losses.cumulative_loss(x, y, 0.5, dim=-4))
    torch.testing.assert_close(losses.multiscale_loss(a, b), losses.multiscale_loss(x, y, dim=-4))


def test_where_time_is_comes_from_the_scan():
    """An exhaustive capture and a list, which ask for `dim` as tensors."""
    exhaustive, points = torch.rand(2, BINS, 2, 2, 3, 3), torch.rand(2, BINS, 7)
    for x, shape, dim in ((exhaustive, (2, 2, 3, 3), -5), (points, (7,), -2)):
        y = x.flip(-1)
        with pytest.raises(ShapeError, match="dim="):
            losses.wasserstein_loss(x, y, 0.05)
        captures = [result(t, scan=SimpleNamespace(shape=shape)) for t in (x, y)]
        found = losses.wasserstein_loss(*captures, reduction="none")
        torch.testing.assert_close(found, losses.wasserstein_loss(x, y, 0.05, dim=dim, reduction="none"))
    stokes = torch.rand(2, 4, 3, BINS, 4, 5)  # a batch of Stokes components
    torch.testing.assert_close(
        losses.wasserstein_loss(result(stokes), stokes.flip(-1)),
        losses.wasserstein_loss(stokes, stokes.flip(-1), 0.05, dim=-3),
    )


def test_a_capture_with_transient_and_phasor_beside_a_phasor():
    x, p = torch.rand(1, BINS, 2, 2), torch.randn(1, 5, 2, 2, dtype=torch.complex64)
    both = SimpleNamespace(transient=x, phasor=p, axis=AXIS, frequencies=BAND)
    alone = result(2 * p, "phasor", None, frequencies=BAND)
    torch.testing.assert_close(losses.squared_loss(both, alone), losses.squared_loss(p, 2 * p))
    torch.testing.assert_close(losses.squared_loss(both, x + 1), losses.squared_loss(x, x + 1))


def test_renders_of_the_library():
    """A rendered result, a `Capture` and an `ItofReading`; volumes are tested with the total variation."""
    from torchtransient.capture import Capture, Scan, Wall
    from torchtransient.files import Result
    from torchtransient.sensing import ItofReading

    x = torch.rand(1, BINS, 2, 2)
    scan = Scan.grid(Wall.plane(1.0, 1.0), (2, 2), kind="confocal")
    capture = Capture(x, AXIS, scan)
    rendered = Result(2 * x, 2 * x.sum(-3), AXIS)
    torch.testing.assert_close(losses.wasserstein_loss(rendered, capture), torch.tensor(0.0), atol=1e-7, rtol=0)
    torch.testing.assert_close(losses.cumulative_loss(capture, rendered), losses.cumulative_loss(x, 2 * x, 0.05))
    phase, amplitude, offset, deviation = torch.rand(4, 1, 2, 3, 3)
    reading = ItofReading(phase, amplitude, offset=offset, depth_std_m=deviation, depth_m=torch.rand(1, 3, 3))
    torch.testing.assert_close(losses.depth_loss(reading, reading.depth_m + 1), torch.tensor(1.0))


def test_a_width_that_is_given_counts_more_than_that_of_a_result():
    x, y = (torch.rand(1, BINS, 3, 3, generator=torch.Generator().manual_seed(s)) for s in (0, 1))
    found = losses.cumulative_loss(result(x), result(y), 1.0)
    torch.testing.assert_close(found, losses.cumulative_loss(x, y, 1.0))
    with pytest.raises(UnitError, match="bin_width_opl"):
        losses.cumulative_loss(x, y)
    with pytest.raises(ArgumentError, match="expected a TimeAxis"):
        losses.transient_phasor_loss(x, y, frequencies=BAND)


@pytest.mark.parametrize(
    ("other", "one"),
    [
        (TimeAxis(1.00005, 0.1, 10), True),
        (TimeAxis(1.0, 0.101, 10), False),  # ends later
        (TimeAxis(0.99, 0.101, 10), False),  # begins sooner, ends alike
        (TimeAxis(1.0005, 0.1, 10), False),
        (TimeAxis(1.0, 1.0 / 11, 11), False),  # as long, in other bins
    ],
)
def test_time_axes_that_are_one(other, one):
    """Start, end and number of bins, each to a thousandth of a bin."""
    axis = TimeAxis(1.0, 0.1, 10)
    a, b = (result(torch.rand(1, each.num_bins, 2, 2), axis=each) for each in (axis, other))
    if one:
        assert losses.wasserstein_loss(a, b).item() > 0
    else:
        with pytest.raises((UnitError, ShapeError), match=r"one axis|shape"):
            losses.wasserstein_loss(a, b)


@pytest.mark.parametrize(("frequencies", "shift", "one"), [((0.5, 900.0), 1e-4, False), ((1e-4, 1e-3), 0.5, True)])
def test_frequency_axes_that_are_one(frequencies, shift, one):
    """Two starts differ by the phase that they turn, the start times the highest frequency in cycles."""
    x = torch.ones(1, 2, 2, 2) + 0j
    a, b = (
        result(x, "phasor", None, frequencies=FrequencyAxis(frequencies, start)) for start in (1.0, 1.0 + shift)
    )
    if one:
        assert losses.phasor_loss(a, b).item() == 0
        return
    for loss in (losses.phasor_loss, losses.squared_loss):
        with pytest.raises(UnitError, match="one axis"):
            loss(a, b)

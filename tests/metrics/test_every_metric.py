"""Contract of every metric: perfect answers, batches, masks, precisions, errors."""

import inspect
import math
from types import SimpleNamespace

import pytest
import torch

import torchtransient as tt
from support.metric_cases import CASES
from support.sweeps import together
from torchtransient import metrics
from torchtransient.errors import ArgumentError, ShapeError, UnitError

every = together("case", CASES)
# No metrics of a pair with a mean: maps, a median, points, the accumulator.
OTHERS = {"wrapped_difference", "front_view", "front_depth", "depth_median_error", "localization_rmse", "Running"}
# Neighbors of a masked pixel see zeros, by windows.
WINDOWED = ("ssim", "transient_ssim")
# Half precision rounds the values at a threshold.
SHARES = ("depth_delta", "depth_gross_errors", "picture_iou", "volume_iou")


def test_no_metric_is_missed():
    public = {name for name in vars(metrics) if not name.startswith("_") and callable(getattr(metrics, name))}
    assert {case.function.__name__ for case in CASES} | OTHERS == public
    assert tt.metrics is metrics


@every
def test_equal_tensors(case):
    x, _ = case.pair()
    found = float(case(x, x))
    if case.options.get("smoothing"):
        assert 0 < found < case.best
    elif case.best == 1.0:
        assert found == pytest.approx(1.0, abs=1e-6)
    else:
        assert found == case.best


@every
@pytest.mark.parametrize("masked", [False, True], ids=["all", "masked"])
def test_running_sums_are_those_of_all_batches(case, masked):
    """However the batches are cut, one of them empty."""
    x, y = case.pair()
    mask = case.mask() if masked else None
    whole = case(x.double(), y.double(), mask=mask)
    running = metrics.Running(case.function, **case.options)
    assert math.isnan(float(running.compute()))
    for part in (slice(0, 2), slice(2, 2), slice(2, 3)):
        if part.stop == part.start and case.function in (metrics.front_depth_mae,):
            continue
        running.update(x[part].double(), y[part].double(), mask=None if mask is None else mask[part])
    torch.testing.assert_close(running.compute(), whole, rtol=1e-12, atol=1e-15)
    running.reset()
    assert math.isnan(float(running.compute()))
    first = running(x, y)
    torch.testing.assert_close(running.compute().float(), first, rtol=1e-6, atol=1e-12)


@every
def test_items_and_elements(case):
    x, y = (one.double() for one in case.pair())
    mask = case.mask()
    each = case(x, y, mask=mask, reduction="item")
    assert len(each) == 3
    alone = torch.stack([case(x[k : k + 1], y[k : k + 1], mask=mask[k : k + 1]) for k in range(3)])
    # An item of polarization is a picture of one channel and time, and one of pictures of bins is a bin.
    if not str(case).startswith(("dop_", "aolp_")) and not str(case).endswith(", bins"):
        assert each.ndim == 1
        torch.testing.assert_close(each, alone, rtol=1e-12, atol=1e-15)
    elements = case(x, y, reduction="none")
    assert bool(elements.isfinite().all())
    hidden = case(x, y, mask=torch.zeros_like(mask), reduction="none")
    assert bool(hidden.isnan().all()) and hidden.shape == elements.shape


@every
def test_what_the_mask_leaves_out_has_no_part(case):
    x, y = case.pair()
    mask = case.mask()
    clean = case(x, y, mask=mask)
    where = mask.unsqueeze(1) if x.ndim > mask.ndim else mask
    if case.function is metrics.front_depth_mae:
        where = mask.unsqueeze(1)
    for nothing in (torch.nan, torch.inf, -3.0):
        if case.function is metrics.front_depth_mae and nothing != -3.0:
            continue  # a column with NaN is no surface, which the volume's threshold does not see
        a, b = (torch.where(where, one, torch.full_like(one, nothing)) for one in (x, y))
        torch.testing.assert_close(case(a, b, mask=mask), clean, rtol=0, atol=0)
    if case.function.__name__ not in WINDOWED:
        assert float(clean) != float(case(x, y)) or case.function.__name__ in SHARES


@every
def test_nothing_counts(case):
    x, y = case.pair()
    assert math.isnan(float(case(x, y, mask=torch.zeros(case.counts, dtype=torch.bool))))


@pytest.mark.filterwarnings("ignore:Anomaly Detection")
@every
def test_an_item_of_which_nothing_counts_has_slope_zero(case):
    x, y = case.pair()
    mask = case.mask()
    mask[1] = False
    x.requires_grad_()
    each = case(x, y, mask=mask, reduction="item")
    assert bool(each[1].isnan().all()) and bool(each[0].isfinite().all())
    if each.requires_grad:
        # NaN on the way back is an error; of the way there, stacks would be kept for each step.
        with torch.autograd.detect_anomaly(check_nan=True):
            each[~each.isnan()].sum().backward()
        assert bool(x.grad.isfinite().all()) and not bool(x.grad[1].any())


@every
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16], ids=str)
def test_half_precision_is_measured_in_single(case, dtype):
    x, y = (one.to(dtype) for one in case.pair())
    found = case(x, y)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, case(x.float(), y.float()), rtol=0, atol=0)
    assert case(x.double(), y).dtype == torch.float64


@every
def test_estimates_that_are_none_are_refused(case):
    x, y = case.pair()
    for nothing in (torch.nan, torch.inf):
        broken = x.clone().flatten()
        broken[-1] = nothing
        if case.function is metrics.front_depth_mae:
            assert math.isfinite(float(case(broken.view_as(x), y)))  # an empty column, by `depth_map`
            continue
        with pytest.raises(UnitError, match=r"finite"):
            case(broken.view_as(x), y)


@every
def test_what_would_be_wrong_in_silence_is_an_error(case):
    """Shapes that broadcast, weights in the place of a mask, imaginary parts, a reduction by another name."""
    x, y = case.pair()
    with pytest.raises(ShapeError):
        case(x, y[..., :1])
    with pytest.raises(UnitError):
        case(x.to(torch.complex64), y)
    with pytest.raises(UnitError, match="mask of truth values"):
        case(x, y, mask=torch.ones(1))
    with pytest.raises(ShapeError, match="mask that broadcasts"):
        case(x, y, mask=torch.ones(99, dtype=torch.bool))
    with pytest.raises(ArgumentError, match="reduction"):
        case(x, y, reduction="sum")


# The attribute of a result that a metric reads, by the type that its signature names.
READ = {"DepthMap": "depth_m", "Phasors": "phasor", "Transient": "transient", "Picture": "steady", "Volume": "values"}


@every
def test_results_are_their_tensors(case):
    kind = inspect.signature(case.function).parameters["input"].annotation
    if kind == "Tensor":
        return
    x, y = case.pair()
    a, b = (SimpleNamespace(**{READ[kind]: one}) for one in (x, y))
    wanted = case(x, y)
    for pair in ((a, b), (a, y), (x, b)):
        torch.testing.assert_close(case(*pair), wanted, rtol=0, atol=0)

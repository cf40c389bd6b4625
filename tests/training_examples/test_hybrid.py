"""Network and renderer together: the two examples run, and what they share is what it is said to be."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest
import torch

FOLDER = Path(__file__).parents[2] / "training_examples"


@pytest.fixture
def example(monkeypatch):
    """The scripts import each other, as they do where one of them is run."""
    monkeypatch.syspath_prepend(FOLDER)
    return importlib.import_module


@pytest.fixture(autouse=True)
def one_thread():
    import torchtransient as tt

    with tt.threads(1):
        yield


def ratios(printed):
    return [float(x) for x in re.findall(r": ([\d.]+) of the error of ", printed)]


@pytest.mark.slow
def test_the_renderer_corrects_the_network(example, tmp_path, capsys):
    amortised = example("amortised")
    table = amortised.main(["--smoke", "--seeds", "0", "--output", str(tmp_path)])
    network, hybrid = table.percent(amortised.NETWORK), table.percent(amortised.HYBRID)
    assert hybrid < 0.9 * network
    assert hybrid < 0.7 * table.percent(amortised.BEST)
    # It ends near what the counts can say only where it starts there.
    assert table.percent("renderer from the truth, 512 spp") < 0.5 * hybrid
    expected = [hybrid / table.percent(name) for name in (amortised.TWICE, amortised.BEST)]
    assert ratios(capsys.readouterr().out) == pytest.approx(expected, abs=0.006)
    assert (tmp_path / "amortised.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_counter_and_scenes_are_learnt_together(example, tmp_path, capsys):
    script = example("self_calibration")
    table = script.main(["--smoke", "--seeds", "0", "--output", str(tmp_path)])
    assert table.percent(script.TOGETHER) < table.percent("network, wrong counter")
    names = (script.RANDOM, script.WRONG, script.TRUE)
    expected = [table.percent(script.TOGETHER) / table.percent(name) for name in names]
    assert ratios(capsys.readouterr().out) == pytest.approx(expected, abs=0.006)
    assert (tmp_path / "self_calibration.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_unknowns_are_those_of_the_recipe(example):
    walls = example("two_walls")
    unknowns, light = walls.scenes(7, 3, 1024, "test")
    assert bool(((unknowns >= walls.LOW) & (unknowns <= walls.HIGH)).all())
    assert len(torch.unique(unknowns, dim=0)) == 3
    with torch.no_grad():
        again = walls.renderer()(walls.values_of(unknowns), spp=1024, seed=5).transient
    # The noise of both renders, some per cent of the bins with light.
    off = (again - light).abs().sum((1, 2, 3, 4)) / light.sum((1, 2, 3, 4))
    other = (again - light.roll(1, 0)).abs().sum((1, 2, 3, 4)) / light.sum((1, 2, 3, 4))
    assert float(off.max()) < 0.1
    assert float(other.min()) > 0.3


def test_responses_of_all_counters_sum_to_one(example):
    counters = example("unknown_counters")
    torch.manual_seed(0)
    captures = torch.rand(2, 1, 64, 8, 8)
    learnt = counters.learnable_counter(True, captures)
    for sensor in (counters.true_counter(), counters.random_counter(), learnt):
        kernel = counters.kernel_of(sensor)
        assert kernel.shape == counters.LAGS.shape
        assert float(kernel.detach().sum()) == pytest.approx(1, abs=2e-3)
        assert bool((counters.level_of(sensor) > 0).all())
    # A response that begins as a core in its place, and whose every part learns.
    assert abs(float(counters.LAGS[counters.kernel_of(learnt).argmax()])) == 0
    light = torch.rand(1, 1, 64, 8, 8)
    learnt.expected(light).square().sum().backward()
    for name, parameter in learnt.named_parameters():
        # The last layers of both networks begin at zero, and hide those before them.
        moved = not name.endswith("delay_ps") and not re.search(r"network\.[02]\.", name)
        assert (parameter.grad is not None and bool(parameter.grad.ne(0).any())) == moved, name


@pytest.mark.soak
def test_errors_are_as_low_as_said(example, tmp_path):
    """One seed of three; the docs have the means of three."""
    amortised = example("amortised")
    table = amortised.main(["--seeds", "1", "--output", str(tmp_path)])
    assert table.percent(amortised.HYBRID) < 0.7 * table.percent(amortised.TWICE)
    assert table.percent(amortised.HYBRID) < 0.25 * table.percent(amortised.BEST)


@pytest.mark.soak
def test_an_unknown_counter_costs_little(example, tmp_path):
    """One seed of three."""
    script = example("self_calibration")
    table = script.main(["--seeds", "0", "--output", str(tmp_path)])
    assert table.percent(script.TOGETHER) < 0.7 * table.percent(script.RANDOM)
    assert table.percent(script.TOGETHER) < 0.5 * table.percent(script.WRONG)
    assert table.percent(script.TOGETHER) < 1.4 * table.percent(script.TRUE)

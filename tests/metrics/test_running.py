"""Sums over batches and processes."""

import copy
import math
import pickle
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import torch.distributed as dist

from torchtransient import losses, metrics
from torchtransient.errors import ArgumentError
from torchtransient.metrics import Running

TWO = """
import sys
import torch
import torch.distributed as dist
from torchtransient import metrics
rank, folder = int(sys.argv[1]), sys.argv[2]
dist.init_process_group("gloo", init_method=f"file://{folder}/store", rank=rank, world_size=2)
x = torch.arange(24.0).view(4, 2, 3) / 10
found = []
for function in (metrics.depth_rmse, metrics.phase_bias):
    running = metrics.Running(function)
    for part in ((0, 3), (3, 4))[rank:rank + 1]:
        running.update(x[slice(*part)], torch.zeros_like(x[slice(*part)]))
    found.append(running.compute(across_ranks=True) - function(x.double(), torch.zeros_like(x)))
    if running.compute() == running.compute(across_ranks=True):
        raise SystemExit("what this process has changed")
    running.reset()
    if rank:
        running.update(x, x)
    found.append(running.compute(across_ranks=True))
# A process that ends while gloo has threads ends by SIGABRT.
dist.barrier()
dist.destroy_process_group()
if max(abs(float(f)) for f in found) > 1e-6:
    raise SystemExit(str(found))
"""


def test_what_is_no_metric():
    with pytest.raises(ArgumentError, match=r"expected a metric of tt\.metrics"):
        Running(metrics.depth_median_error)
    with pytest.raises(ArgumentError, match="reduction"):
        Running(losses.squared_loss).update(torch.ones(2, 2), torch.ones(2, 2))
    with pytest.raises(TypeError, match="reduction"):
        Running(metrics.depth_mae).update(torch.ones(2, 2), torch.ones(2, 2), reduction="item")
    with pytest.raises(ArgumentError, match="process group"):
        Running(metrics.depth_mae).compute(across_ranks=True)


def test_copies_and_casts():
    running = Running(metrics.depth_gross_errors, beyond_m=0.5)
    x = torch.linspace(0, 1, 10).view(2, 5).requires_grad_()
    assert not running(x, torch.zeros(2, 5)).requires_grad
    others = [copy.deepcopy(running), pickle.loads(pickle.dumps(running)), copy.deepcopy(running).half()]
    for other in others:
        assert float(other.compute()) == 0.5
        other.update(x, x)
        assert float(other.compute()) == 0.25
    assert float(running.compute()) == 0.5
    assert running.compute().dtype == torch.float64
    assert not running.state_dict() and "beyond_m=0.5" in repr(running)


def test_one_process(tmp_path):
    dist.init_process_group("gloo", init_method=f"file://{tmp_path}/store", rank=0, world_size=1)
    try:
        running = Running(metrics.phase_bias)
        assert math.isnan(float(running.compute(across_ranks=True)))
        running.update(torch.full((2, 3), 3.1), torch.full((2, 3), -3.1))
        wanted = pytest.approx(6.2 - 2 * math.pi, abs=1e-6)
        assert float(running.compute(across_ranks=True)) == wanted
        assert float(running.compute(across_ranks=True)) == wanted
    finally:
        dist.destroy_process_group()


@pytest.mark.slow
def test_two_processes(tmp_path):
    root = str(Path(metrics.__file__).parents[2])
    command = [sys.executable, "-c", TWO]
    started = [subprocess.Popen([*command, str(rank), str(tmp_path)], cwd=root) for rank in (0, 1)]
    assert [one.wait(120) for one in started] == [0, 0]

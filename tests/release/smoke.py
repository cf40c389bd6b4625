"""What an installed torchtransient has to do, away from its sources.

`cd /; PYTHON -W error smoke.py` with the Python that has it, and the extra `cpu`. Prints a line for each check and ends
with status 1 at the first that fails.
"""

from __future__ import annotations

import importlib.metadata
import importlib.resources
import json
import subprocess
import sys
import sysconfig
from collections.abc import Callable
from pathlib import Path

import torch

import torchtransient as tt


def check_files() -> str:
    """The files that are no Python came along, and nothing else was found on the way."""
    package = Path(tt.__file__).parent
    assert not (package.parent / "pyproject.toml").exists(), f"{package} is a checkout, run this elsewhere"
    files = importlib.resources.files("torchtransient")
    assert files.joinpath("py.typed").is_file()
    table = json.loads(files.joinpath("plugins/swept_parameters.json").read_text())
    assert table, "the table of swept parameters is empty"
    distribution = importlib.metadata.distribution("torchtransient")
    assert distribution.version == tt.__version__
    assert distribution.metadata["License-Expression"] == "BSD-3-Clause"
    assert any(path.name == "LICENSE" for path in distribution.files or ())
    return f"torchtransient {tt.__version__} in {package}, {len(list(package.rglob('*.py')))} modules"


def check_import() -> str:
    """The import warns of nothing, and no public name needs more than the import."""
    subprocess.run([sys.executable, "-W", "error", "-c", "import torchtransient"], check=True)
    names = [name for name in dir(tt) if not name.startswith("_")]
    for name in names:
        getattr(tt, name)
    return f"no warning, {len(names)} public names"


def check_doctor() -> str:
    """The command finds everything that a render needs."""
    beside = Path(tt.__file__).parents[1] / "bin" / "torchtransient"  # of `pip install --target`
    command = beside if beside.exists() else Path(sysconfig.get_path("scripts"), "torchtransient")
    said = subprocess.run([command, "doctor"], check=True, capture_output=True, text=True).stdout
    assert "renders and differentiates" in said, said
    return said.strip().splitlines()[-1]


def check_gradient() -> str:
    """A render and its derivative, against a finite difference at the same random numbers."""
    key = "red.reflectance.value"
    scene = tt.load(tt.scenes.cornell_box(resolution=8, num_bins=40, bin_width_opl=0.2, max_depth=3))
    renderer = tt.TransientRenderer(scene, parameters=[key], spp=256)
    output = renderer(seed=0)
    assert output.transient.shape == (3, 40, 8, 8)
    output.transient.sum().backward()
    slope = float(renderer.values[key].grad[0])
    sums, step = [], 0.05
    for sign in (1, -1):
        moved = renderer.values[key].detach() + sign * torch.tensor([step, 0.0, 0.0])
        with torch.no_grad():
            sums.append(float(renderer({key: moved}, seed=0).transient.sum()))
    known = (sums[0] - sums[1]) / (2 * step)
    assert abs(slope - known) < 0.1 * known, f"derivative {slope}, finite difference {known}"
    return f"derivative {slope:.4g}, finite difference {known:.4g}"


def check_sensor() -> str:
    """A chain of sensors: whole counts around their means, and a gradient of the means."""
    axis = tt.TimeAxis(start_opl=0.0, bin_width_opl=0.05, num_bins=200)
    pulse = tt.sensing.ImpulseResponse(tt.sensing.GaussianResponse(fwhm_s=200e-12), axis)
    chain = tt.sensing.Compose([pulse, tt.sensing.SynchronousSPAD(cycles=1000)], grad="straight_through")
    light = torch.zeros(1, 200, 8, 8)
    light[:, 60] = 0.5  # photons in a cycle
    light.requires_grad_()
    mean = chain.expected(light)
    counts = chain(light.detach(), generator=torch.Generator().manual_seed(0))
    assert torch.equal(counts, counts.round())
    total, expected = float(counts.sum()), float(mean.detach().sum())
    assert abs(total - expected) < 5 * expected**0.5, f"{total} counts, {expected} expected"
    mean.sum().backward()
    assert float(light.grad.sum()) > 0
    return f"{total:.0f} counts, {expected:.0f} expected"


CHECKS: tuple[Callable[[], str], ...] = (check_files, check_import, check_doctor, check_gradient, check_sensor)


if __name__ == "__main__":
    for check in CHECKS:
        print(f"{check.__name__.removeprefix('check_'):<10} {check()}", flush=True)

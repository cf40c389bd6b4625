"""y-tal 0.20 in a process of its own: captures handed over, volumes and seconds taken back."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _runner import HERE, ChildProcess
from torch import Tensor

import torchtransient as tt


class Tal(ChildProcess):
    """A `_tal_worker.py` process with one thread."""

    def __init__(self, python: str, downscale: int = 1) -> None:
        alone = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        place = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"} | alone
        super().__init__([python, str(HERE / "_tal_worker.py"), str(downscale)], env=place)
        self.folder = tempfile.TemporaryDirectory()

    def load(self, capture: tt.nlos.Capture) -> None:
        """Hand over a capture; x comes first in all of y-tal's arrays."""
        file, scan = str(Path(self.folder.name) / "capture.npz"), capture.scan
        light = capture.transient[0].float()
        turned = light.transpose(-1, -2) if light.ndim == 3 else light.permute(0, 2, 1, 4, 3)
        lasers = scan.laser_points if scan.laser_points.ndim == 3 else scan.laser_points[None, None]
        grids = {"sensors": scan.sensor_points, "lasers": lasers}
        points = {name: grid.transpose(0, 1).float().contiguous().numpy() for name, grid in grids.items()}
        np.savez(file, H=turned.contiguous().numpy(), bin_width=capture.axis.bin_width_opl, **points)
        self.ask(do="capture", file=file)

    def solve(self, method: str, planes: list[float], **options: Any) -> tuple[Tensor, float]:
        """The volume (..., Z, Y, X) and its seconds."""
        out = str(Path(self.folder.name) / "volume.npy")
        seconds = self.ask(do="solve", method=method, planes=planes, out=out, **options)["seconds"]
        volume = torch.from_numpy(np.load(out))
        return volume.transpose(-1, -3), seconds

    def migrate(self) -> tuple[Tensor, float]:
        """The volume (Z, Y, X) of f-k migration and its seconds."""
        out = str(Path(self.folder.name) / "volume.npy")
        seconds = self.ask(do="migrate", out=out)["seconds"]
        return torch.from_numpy(np.load(out)).transpose(1, 2).contiguous(), seconds

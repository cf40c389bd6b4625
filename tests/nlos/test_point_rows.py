"""Captures as rows of numbers: there and back without a change, and without a copy where none is needed."""

from __future__ import annotations

import numpy as np
import torch

from support.sweeps import together
from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Capture, Scan, Wall
from torchtransient.nlos.part_file import RowLayout

WALL = Wall.plane(2.0, 1.6)
SCANS = {
    "confocal": Scan.grid(WALL, (4, 3), kind="confocal"),
    "exhaustive": Scan.grid(WALL, (4, 3), kind="exhaustive", laser_grid=(2, 1)),
    "list": Scan.points([[0.0, 0, 0], [0.1, 0.2, 0]], kind="confocal", sensor_origin=[0, 0, 1], laser_origin=[0, 0, 1]),
}


@together("kind", list(SCANS))
@together("front", [(1,), (3,), (4, 1)])
@together("phasor", [False, True])
@together("steady", [False, True])
def test_there_and_back(kind, front, phasor, steady):
    scan, generator = SCANS[kind], torch.Generator().manual_seed(0)
    polarized = len(front) == 2
    frequencies, axis = FrequencyAxis((0.1, 0.2, 0.3)), TimeAxis(0.5, 0.1, 3)
    cube = torch.randn(*front, 3, *scan.shape, generator=generator, dtype=torch.complex64 if phasor else torch.float32)
    image = torch.randn(*front, *scan.shape, generator=generator) if steady else None
    axes = (None, frequencies) if phasor else (axis, None)
    made = Capture(
        None if phasor else cube, axes[0], scan, phasor=cube if phasor else None, frequencies=axes[1], steady=image,
        channels=tuple("abc"[: front[-1]]), polarized=polarized,
    )  # fmt: skip
    layout = RowLayout.of(made)
    rows = layout.rows(made)
    assert rows.shape == (len(scan.sensor_points.reshape(-1, 3)), layout.columns) and rows.dtype == np.float32
    back = Capture(**RowLayout.from_plain(layout.plain()).capture(rows, scan, *axes))
    assert back.tensors().keys() == made.tensors().keys()
    for name, tensor in made.tensors().items():
        assert torch.equal(back.tensors()[name], tensor)
    assert (back.channels, back.polarized) == (made.channels, made.polarized)
    if not phasor:
        assert back.transient.data_ptr() == torch.from_numpy(rows).data_ptr()

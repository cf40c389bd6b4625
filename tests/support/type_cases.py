"""Right arguments of the public functions and classes that take no number, beside those of `number_cases`."""

from __future__ import annotations

import numpy as np
import torch

import torchtransient as tt
from support.number_case import Case, Table, capture, folder, listed, recipe
from support.number_cases import AXIS, CASES, LIGHT, MESH

STEADY, DARK = LIGHT[:, 0, :4, :4], np.zeros((2, 2, 3))


def _pictures() -> dict[str, Case]:
    v, scan = tt.vis, capture().scan
    monitor = v.FitMonitor({"a": torch.ones(2)}, live=False)
    return {
        "vis.FitMonitor.save": Case(monitor.save, folder() / "fit.png"),
        "vis.peak_time": Case(v.peak_time, LIGHT, AXIS),
        "vis.scan_layout": Case(v.scan_layout, scan),
    }


def _data() -> dict[str, Case]:
    d = tt.data
    pixels = d.PixelMap(np.eye(3), (4, 4), (4, 4))
    return {
        "data.Augment": Case(d.Augment, d.Flip()),
        "data.Affine": Case(d.Affine, torch.nn.Identity()),
        "data.PixelMap.intrinsics": Case(pixels.intrinsics, torch.eye(3)),
        "data.PixelMap.to_world": Case(pixels.to_world, torch.eye(4)),
        "data.PixelMap.mirrored_world": Case(pixels.mirrored_world, torch.eye(4)),
        "data.PixelMap.smooth": Case(d.PixelMap(0.5 * np.eye(3) + np.diag([0, 0, 0.5]), (4, 4), (2, 2)).smooth,
                                     LIGHT[..., :4, :4]),
        "data.Choice": Case(d.Choice, [1.0, 2.0]),
        "data.LogUniform": Case(d.LogUniform, 1.0, 2.0),
        "data.Scale": Case(d.Scale, 1.0, 2.0),
        "data.Uniform": Case(d.Uniform, 0.0, 1.0),
        "data.Compose": Case(d.Compose, [d.Turn([0, 0, 1], 0.0, 9.0)]),
        "data.LookAt": Case(d.LookAt, [0.0, 0, 1], [0.0, 0, 0]),
        "data.Offset": Case(d.Offset, [0.0, 0, 0], [1.0, 0, 0]),
        "data.OneOf": Case(d.OneOf, {"a": {"type": "sphere"}, "b": {"type": "cube"}}),
        "data.Recipe.from_dict": Case(d.Recipe.from_dict, recipe().to_dict()),
        "data.Recipe.read": Case(d.Recipe.read, folder() / "none.yaml"),
        "data.Shard": Case(d.Shard, folder() / "none.h5"),
        "data.build_manifest": Case(d.build_manifest, folder()),
        "data.verify": Case(d.verify, folder()),
        "data.export_tal": Case(d.export_tal, folder(), folder() / "tal"),
        "data.read_web_dataset": Case(listed(d.read_web_dataset), folder() / "none"),
    }  # fmt: skip


def _rest() -> dict[str, Case]:
    p, t, batches = tt.pulses, tt.training, tt.training.Batches(4, 2)
    return {
        "pulses.transform": Case(p.transform, tt.Pulse.gaussian(0.5), [0.0, 1.0]),
        "pulses.Pulse.cumulative": Case(tt.Pulse.gaussian(0.5).cumulative, 0.1),
        "losses.expected_anscombe": Case(tt.losses.expected_anscombe, LIGHT),
        "losses.maximum_projections": Case(tt.losses.maximum_projections, torch.rand(2, 1, 3, 4, 5)),
        "losses.mesh_laplacian_smoothing": Case(tt.losses.mesh_laplacian_smoothing, *MESH),
        "losses.mesh_normal_consistency": Case(tt.losses.mesh_normal_consistency, *MESH),
        "metrics.depth_median_error": Case(tt.metrics.depth_median_error, STEADY, STEADY),
        "metrics.front_view": Case(tt.metrics.front_view, torch.rand(1, 3, 4, 5)),
        "metrics.Running": Case(tt.metrics.Running, tt.metrics.psnr),
        "training.accumulate": Case(t.accumulate, lambda part: torch.ones((), requires_grad=True), range(2)),
        "training.load_checkpoint": Case(t.load_checkpoint, folder() / "none.pt", {"model": torch.nn.Linear(1, 1)}),
        "training.Batches.loader": Case(batches.loader, Table()),
        "training.Batches.load_state_dict": Case(batches.load_state_dict, batches.state_dict()),
        "training.Batches.check_state_dict": Case(batches.check_state_dict, batches.state_dict()),
    }


TYPE_CASES: dict[str, Case] = {**CASES, **_pictures(), **_data(), **_rest()}

"""What a sensor makes of captures, checked before anything is rendered; and captures without light."""

from __future__ import annotations

import inspect
import warnings

import torch
from torch import nn

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.errors import PhysicsWarning, SceneError
from torchtransient.nlos.scene import film_size, laser_size
from torchtransient.sensing import Compose, Device, GradPolicy, Sensor
from torchtransient.sensing.chain.stages import check_axis


def checked_module(sensor: nn.Module | Device, axis: TimeAxis, grad: GradPolicy = "expected") -> nn.Module:
    """A sensor as the module that takes transients on ``axis``; ``grad``: what becomes of a device's noise. Raises
    UnitError for one that was made for another axis, SceneError for one whose answer has other bins.
    """
    module = sensor.sensor(axis, grad=grad) if isinstance(sensor, Device) else sensor
    check_axis(module, axis)
    if isinstance(module, Sensor | Compose):
        with torch.no_grad(), torch.random.fork_rng(devices=[]):
            given = next((tensor for tensor in (*module.parameters(), *module.buffers())), None)
            dark = torch.zeros(1, axis.num_bins, 1, 1, device=None if given is None else given.device)
            bins = module(dark).shape[-3]
        if bins != axis.num_bins:
            raise SceneError(
                f"sensor: expected an answer with the transient's {axis.num_bins} bins, got {bins} of "
                f"{sensor!r}. Apply a sensor with bins of its own to capture.transient."
            )
    return module


def is_readable(tensor: torch.Tensor) -> bool:
    """False under ``torch.vmap``, where Python cannot look at values (torch has no public question for that)."""
    try:
        bool(tensor.any())
    except RuntimeError:
        return False
    return True


def black_message(who: str, within: str = "") -> str:
    """What is said of a capture without light. ``within``: where there is none, of what is known of a part alone."""
    return (
        f"{who}: no light comes back from the hidden things{within}. Meshes scatter on the side that their normals "
        "point to (corners run counterclockwise as seen from there), which has to face the wall; others need a "
        "'twosided' bsdf. Black albedos, energy 0, things behind the wall and bounces= that no light takes give none "
        "either."
    )


def say_black(who: str, capture: Capture) -> None:
    """Warn of a capture without light."""
    found = (capture.steady, capture.transient, capture.phasor)
    light = next(tensor for tensor in found if tensor is not None)
    if not bool(light.any()):
        within = " within the bins" if light is capture.transient else ""
        warnings.warn(black_message(who, within), PhysicsWarning, stacklevel=3)


def measured(transient: torch.Tensor, scan: Scan, sensor: nn.Module, generator: torch.Generator | None) -> torch.Tensor:
    """What ``sensor`` makes of (..., T, [Lh, Lw,] H, W): each pair is a pixel of its own."""
    if scan.kind == "exhaustive":
        (rows, columns), (laser_rows, laser_columns) = film_size(scan), laser_size(scan)
        flat = transient.reshape(*transient.shape[:-4], laser_rows * laser_columns, rows * columns)
        seen = _answer(sensor, flat, generator)
        return seen.reshape(*seen.shape[:-2], *transient.shape[-4:])
    result: torch.Tensor = _answer(sensor, transient, generator)
    return result


def _answer(sensor: nn.Module, transient: torch.Tensor, generator: torch.Generator | None) -> torch.Tensor:
    """Of a module of ``tt.sensing``, or of any other, which may know nothing of generators."""
    known = inspect.signature(sensor.forward).parameters.values()
    if any(one.name == "generator" or one.kind is one.VAR_KEYWORD for one in known):
        answer: torch.Tensor = sensor(transient, generator=generator)
    else:
        answer = sensor(transient)
    return answer

"""Cases of `gpu_cases.py` with the small room: every way in which a render comes, with its gradients.

The room is `testing/small_room.py`: 12 pixels, three bounces. Unless a case says otherwise its tolerance is 1e-2, the
default: at 1024 samples a pixel, one path that rounding turns over is worth 1e-3 of a pixel; 2e-5 was the most seen.
"""

from __future__ import annotations

from typing import Any

import torchtransient as tt  # first: it finds LLVM before Dr.Jit is imported

import mitsuba as mi  # isort: skip
import numpy as np
import torch
from _gpu_cases_registry import Found, Side, case

from tools.small_room import COLOUR, WALL_POSE, make_room
from torchtransient.rendering.labels import scene_labels


def several_calls(side: Side, renderer: tt.TransientRenderer, calls: int = 4) -> Found:
    """Values and gradients of calls of one seed: the first is traced, the second recorded, the others launched.

    The loss has weights of both signs, so that gradients of wrong bins or pixels do not cancel unseen.
    """
    found: Found = {}
    for n in range(calls):
        renderer.zero_grad()
        out = renderer(seed=3)
        if out.transient is not None:
            response = out.transient
        else:
            response = torch.view_as_real(out.phasor) if out.phasor is not None else out.gated
        weight = torch.cos(torch.arange(response.numel(), device=response.device) % 97).view(response.shape)
        if any(p.requires_grad for p in renderer.parameters()):
            ((response * weight).sum() + out.steady.sum()).backward()
        found |= {f"call {n}: response": response, f"call {n}: steady": out.steady}
        for key, parameter in renderer.values.items():
            if parameter.grad is not None:
                found[f"call {n}: gradient by {key}"] = parameter.grad.clone()
        found[f"call {n} on the device"] = response.device.type == side.device
        print("call", n, out.stats.recorded, flush=True)
    return found


def room(side: Side, **options: Any) -> tt.TransientRenderer:
    """A renderer of the room with a colour and a pose, whose gradient goes through the time of flight."""
    options = {"parameters": [COLOUR, WALL_POSE], "spp": 1024, **options}
    return tt.TransientRenderer(tt.load(make_room(), variant=side.variant), **options)


@case()
def mitsuba_alone(side: Side) -> Found:
    """Mitsuba's own render of the Cornell box: where this differs, nothing of ours is to blame."""
    image = mi.render(mi.load_dict(mi.cornell_box()), spp=64, seed=1)
    return {"mean": np.array([np.array(image).mean()])}


@case()
def room_traced(side: Side) -> Found:
    """Calls without recordings: where this agrees and `room_recorded` does not, the recordings are wrong."""
    return several_calls(side, room(side, freeze=False), calls=2)


@case(quick=True)
def room_recorded(side: Side) -> Found:
    """Calls as users have them: traced, recorded, launched."""
    return several_calls(side, room(side))


@case("mono")
def room_mono(side: Side) -> Found:
    """Monochromatic variants."""
    return several_calls(side, room(side))


@case("mono_polarized")
def room_polarized(side: Side) -> Found:
    """Polarized variants: Mueller matrices in the kernel's loop state."""
    return several_calls(side, room(side))


@case()
def room_phasors(side: Side) -> Found:
    """The film of phasors."""
    return several_calls(side, room(side, frequencies=tt.FrequencyAxis.uniform(0.0, 0.15, 5)))


@case()
def room_gates(side: Side) -> Found:
    """The film of gates."""
    return several_calls(side, room(side, gates=[tt.Gate.gaussian(8.0, 1.0), tt.Gate.gaussian(10.0, 2.0)]))


@case()
def room_tent_and_pulse(side: Side) -> Found:
    """A temporal filter that writes two bins a sample, and a pulse."""
    return several_calls(side, room(side, temporal_filter="tent", pulse=tt.Pulse.gaussian(fwhm_opl=0.5)))


@case()
def room_jvp(side: Side) -> Found:
    """Forward mode, in which tangents are accumulated beside the values."""
    renderer = room(side)
    value = torch.tensor([0.8, 0.5, 0.2], device=side.device)
    found: Found = {}
    for n in range(3):
        out, tangent = torch.func.jvp(
            lambda v: renderer({COLOUR: v}, seed=3).transient, (value,), (torch.ones_like(value),)
        )
        found |= {f"call {n}: tangent": tangent, f"call {n}: value": out}
    return found


@case()
def room_batches(side: Side) -> Found:
    """A batch of values, and its gradient."""
    renderer = room(side)
    values = torch.tensor([[0.8, 0.5, 0.2], [0.1, 0.2, 0.3]], device=side.device).requires_grad_()
    found: Found = {}
    for n in range(3):
        values.grad = None
        out = renderer({COLOUR: values}, seed=3)
        out.transient.square().sum().backward()
        found |= {f"call {n}: transient": out.transient, f"call {n}: gradient": values.grad.clone()}
    return found


@case()
def large_film(side: Side) -> Found:
    """Several films of 64 x 64 x 200 in one tensor, with a seed each. Sums: 6e-5 was seen, of float32 atomics."""
    description = make_room()
    description["sensor"]["film"] |= {"width": 64, "height": 64, "temporal_bins": 200, "bin_width_opl": 0.03}
    renderer = tt.TransientRenderer(tt.load(description, variant=side.variant), parameters=[COLOUR], spp=16)
    values = torch.tensor([[0.8, 0.5, 0.2], [0.1, 0.2, 0.3], [0.5, 0.5, 0.5]], device=side.device)
    out = renderer({COLOUR: values}, seed=[1, 2, 3])
    return {"transient": out.transient.sum((-1, -2)), "steady": out.steady.mean((-1, -2))}


@case()
def many_samples(side: Side) -> Found:
    """More than 2^16 samples a pixel, which films add in double precision."""
    return several_calls(side, room(side, spp=2**16 + 64), calls=1)


@case(rtol=1e-4)
def label_maps(side: Side) -> Found:
    """Labels. One ray a pixel, at its centre and away from edges: rounding alone, 2e-7 seen, hence 1e-4."""
    names = ("depth", "position", "normals", "albedo", "shape")
    renderer = room(side, parameters=())
    found: Found = {}
    for n in range(3):
        maps = scene_labels(renderer, names=names)
        for name in names:
            found[f"call {n}: {name}"] = torch.nan_to_num(maps[name].double(), 0.0, 0.0, 0.0)
    return found


@case()
def wrapped_render(side: Side) -> Found:
    """`mi.render` inside of `tt.wrap`, with its gradient, on the Cornell box: 256^2 pixels outweigh single paths."""
    scene = mi.load_dict(mi.cornell_box() | {"integrator": {"type": "prb", "max_depth": 4}})
    parameters = mi.traverse(scene)
    f = tt.wrap(lambda params, seed: mi.render(scene, params, spp=16, seed=seed), parameters)
    x = torch.tensor([0.5, 0.2, 0.1], device=side.device).requires_grad_()
    out = f({"red.reflectance.value": x}, seed=1)
    out.mean().backward()
    return {"image": out.mean((0, 1)), "gradient": x.grad, "on the device": out.device.type == side.device}

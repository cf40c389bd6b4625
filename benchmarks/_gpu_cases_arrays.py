"""Cases of `gpu_cases.py` beside the renderer: Dr.Jit's arrays, tensors across both libraries, streams, the doctor."""

from __future__ import annotations

import subprocess
import sys

import torchtransient as tt  # first: it finds LLVM before Dr.Jit is imported

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip
import numpy as np
import torch
from _gpu_cases_registry import Found, Side, case

from tools.small_room import make_room

FLOATS = (torch.float32, torch.float64, torch.float16, torch.bfloat16)


@case(rtol=2e-3, quick=True)
def drjit_arrays(side: Side) -> Found:
    """What the films and records are made of: sums, atomics in both precisions, local arrays, loops, host copies.

    Whole numbers below 2^24, which both add exactly (0 was seen): the tolerance is that of `wrapped`.
    """
    x = dr.arange(mi.Float, 1000)
    tenth = mi.UInt32(x) % 10
    h = dr.zeros(mi.Float, 10)
    dr.scatter_reduce(dr.ReduceOp.Add, h, x, tenth)
    d = dr.zeros(mi.Float64, 10)
    dr.scatter_reduce(dr.ReduceOp.Add, d, mi.Float64(x), tenth)
    n = dr.zeros(mi.Float, 1000)
    dr.scatter_reduce(dr.ReduceOp.Add, n, x, mi.UInt32(x), True, dr.ReduceMode.NoConflicts)
    e = dr.zeros(mi.Float, 10)
    dr.scatter_reduce(dr.ReduceOp.Add, e, x, tenth, True, dr.ReduceMode.Direct)
    local = dr.alloc_local(mi.Float, 8)
    i, total = mi.UInt32(0), mi.Float(0)

    def body(i: mi.UInt32, total: mi.Float, local: dr.Local) -> tuple[mi.UInt32, mi.Float, dr.Local]:
        local[i % 8] = x + mi.Float(i)
        total += local[i % 8]
        return i + 1, total, local

    i, total, local = dr.while_loop((i, total, local), lambda i, total, local: i < 20, body)
    return {
        "atomics": np.array(h),
        "atomics in double precision": np.array(d),
        "no conflicts": np.array(n),
        "direct": np.array(e),
        "loop over local memory": np.array(total),
        "negative number as unsigned": np.array(mi.UInt32(mi.Int32(mi.Float(-3.0))), dtype=np.float64),
        "list of scalars": np.array([mi.Float(1.5), mi.Float(2.5)]).reshape(-1),
        "from numpy": np.array(mi.Float(np.arange(5.0, dtype=np.float32))),
        "item": np.array([float(dr.sum(x)[0])]),
        "opaque": np.array(dr.opaque(mi.Float, 3) * 2),
    }


@case(rtol=2e-3, quick=True)
def bridge(side: Side) -> Found:
    """Tensors pass between the libraries without a copy and stay on the device. Exact: 0 was seen."""
    given = torch.arange(1000, dtype=torch.float32, device=side.device)
    back = mi.TensorXf(given).torch()
    made = mi.TensorXf(dr.arange(mi.Float, 1000), (10, 100))
    dr.eval(made)
    out = made.torch()
    part = mi.Float(given[1:])  # begins four bytes beyond an aligned place
    return {
        "there and back is the same memory": back.data_ptr() == given.data_ptr(),
        "on the device": out.device.type == side.device and back.device.type == side.device,
        "tensor of Dr.Jit": out,
        "unaligned memory": (part * 2).torch(),
    }


@case(rtol=2e-3)
def wrapped(side: Side) -> Found:
    """`tt.wrap` in every dtype, small (host memory at times) and large: values, gradients, jvp, views, vmap.

    2e-3: room for float16 that round to the other side (1e-3 each), and for a tenth of the bfloat16 (4e-3 to 8e-3).
    4e-7 was seen: none did.
    """
    found: Found = {}

    @tt.wrap
    def f(x: mi.TensorXf, y: mi.TensorXf) -> tuple[mi.TensorXf, mi.TensorXf]:
        return dr.sin(x) * y, dr.sum(x * y, axis=None)

    for n in (5, 1000):
        for dtype in FLOATS:
            x = torch.linspace(0, 1, n, device=side.device, dtype=dtype).requires_grad_()
            y = torch.linspace(1, 2, n, device=side.device, dtype=dtype).requires_grad_()
            a, b = f(x, y)
            (a.sum() + b.sum()).backward()
            name = f"{n} of {dtype}"
            found |= {f"{name}: product": a.float(), f"{name}: sum": b.float()}
            found |= {f"{name}: gradient by x": x.grad.float(), f"{name}: gradient by y": y.grad.float()}
            found[f"{name}: on the device"] = a.device.type == side.device and x.grad.device.type == side.device
    whole = tt.wrap(lambda k: k * 3)
    for dtype in (torch.int32, torch.int64, torch.uint8):
        found[f"{dtype}"] = whole(torch.arange(100, device=side.device).to(dtype))
    found["torch.bool"] = tt.wrap(lambda k: ~k)(torch.arange(100, device=side.device) % 3 == 0)
    x = torch.linspace(0, 1, 1000, device=side.device)
    value, tangent = torch.func.jvp(lambda x: f(x, 2 * x)[0], (x,), (torch.ones_like(x),))
    found |= {"jvp": tangent, "value of jvp": value}
    found["views"] = f(x[1:], x[:-1])[0]
    found["transposed"] = f(x.view(10, 100).T, x.view(10, 100).T)[0]
    found["vmap"] = torch.func.vmap(lambda x: f(x, x)[0])(x.view(10, 100))
    return found


@case(compared=False, cuda_only=True)
def streams(side: Side) -> Found:
    """`tt.wrap` on a stream of torch's own: it waits for what is queued there, and its memory lives until it is read.

    Whole numbers: equal or not.
    """
    found: Found = {}
    double = tt.wrap(lambda x: x * 2)
    own = torch.cuda.Stream()
    big = torch.ones(1 << 26, device="cuda")
    with torch.cuda.stream(own):
        torch.cuda._sleep(200_000_000)
        x = big * 3
        y = double(x)
        found["reads what is queued"] = bool((y == 6).all())
        x = big * 5
        expected, pending = [], []
        for k in range(6):
            y = double(x + k)
            torch.cuda._sleep(50_000_000)
            pending.append(y.double().sum())
            expected.append(2.0 * (5 + k) * big.numel())
            del y
    torch.cuda.synchronize()
    found["memory is not reused while it is read"] = [p.item() for p in pending] == expected
    return found


@case(compared=False, cuda_only=True)
def streams_of_renders(side: Side) -> Found:
    """As `streams`, of renders, whose results nothing waits for.

    1e-5 against the same renders read one by one: atomics add in any order; memory reused too early is another render.
    """
    room = make_room()
    room["sensor"]["film"] |= {"width": 128, "height": 128, "temporal_bins": 300, "bin_width_opl": 0.02}
    renderer = tt.TransientRenderer(tt.load(room, variant=side.variant), spp=4)
    with torch.no_grad():
        expected = [renderer(seed=k).transient.double().square().sum().item() for k in range(6)]
        own = torch.cuda.Stream()
        with torch.cuda.stream(own):
            pending = []
            for k in range(6):
                out = renderer(seed=k).transient
                torch.cuda._sleep(100_000_000)
                pending.append(out.double().square().sum())
                del out
        torch.cuda.synchronize()
        default = [renderer(seed=k).transient.double().square().sum() for k in range(6)]
    return {
        "own stream": np.allclose([p.item() for p in pending], expected, rtol=1e-5),
        "default stream": np.allclose([p.item() for p in default], expected, rtol=1e-5),
    }


@case(compared=False)
def doctor(side: Side) -> Found:
    """`torchtransient doctor` finds no problem, and a variant of this side that renders and differentiates."""
    command = [sys.executable, "-m", "torchtransient", "doctor"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    print(done.stdout, done.stderr)
    lines = [line.split(maxsplit=2) for line in done.stdout.splitlines()]
    return {
        "no problem": done.returncode == 0,
        "renders": ["ok", side.variant, "renders and differentiates"] in lines,
    }

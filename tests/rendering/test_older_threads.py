"""Derivatives in threads that are older than the scene: torch calls backwards of CUDA tensors in such ones."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import drjit as dr
import mitsuba as mi
import pytest
import torch

import torchtransient as tt
from tools.small_room import COLOUR, VARIANT, make_room


@pytest.fixture(scope="module")
def older():
    """A thread in which Dr.Jit has worked before anything below is made."""
    mi.set_variant(VARIANT)
    with ThreadPoolExecutor(1) as pool:
        pool.submit(lambda: dr.eval(dr.arange(mi.Float, 4) + 1)).result()
        yield lambda function, *args, **options: pool.submit(function, *args, **options).result()


def newer_block():
    dr.detail.new_scope(dr.JitBackend.LLVM)


def test_wrapped_functions_read_what_is_not_evaluated(older):
    """As handles of OptiX are not: made by a younger block of this thread, read by the derivative in the older one."""
    mi.set_variant(VARIANT)
    newer_block()
    hidden = dr.arange(mi.Float, 4) * mi.Float(dr.opaque(mi.Float, 2))

    @tt.wrap
    def product(x):
        return x.array * hidden

    x = torch.ones(4, requires_grad=True)
    older(lambda: product(x).sum().backward())
    assert x.grad.tolist() == [0, 2, 4, 6]


def test_renders_read_what_is_not_evaluated(older):
    mi.set_variant(VARIANT)
    scene = mi.load_dict(make_room())
    renderer = tt.TransientRenderer(scene, [COLOUR], spp=2, freeze=False)
    renderer(seed=0).transient.sum().backward()
    expected = renderer.values[COLOUR].grad.clone()
    newer_block()
    params, light = mi.traverse(scene), "light.intensity.value"
    params[light] = params[light] * dr.opaque(mi.Float, 2)
    params.update()
    renderer.zero_grad()
    older(lambda: renderer(seed=0).transient.sum().backward())
    torch.testing.assert_close(renderer.values[COLOUR].grad, 2 * expected)

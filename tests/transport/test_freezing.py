"""A render and its derivatives are functions of values, adjoint and seed: nothing of a call is part of a kernel.

What can be recorded by ``dr.freeze`` is shown by recording it: one recording serves all seeds, with equal bits.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.marks import long, long_rows
from support.plain_scenes import as_mitsuba
from torchtransient.plugins.guards import no_collection
from torchtransient.scenes import cornell_box

VARIANT = "llvm_ad_mono"
pytestmark = pytest.mark.usefixtures("no_leftovers")
KEY = "red.reflectance.value"


def scene_of(kind):
    """A Cornell box whose light passes what ``kind`` says."""
    result = as_mitsuba(cornell_box(resolution=4, num_bins=40, bin_width_opl=0.2, max_depth=4))
    result["sensor"]["film"]["temporal_filter"] = "tent"
    small = result["small-box"]
    if kind == "media":
        result["integrator"] = result["integrator"] | {"type": "transient_prbvolpath"}
        fog = {"type": "homogeneous", "sigma_t": 2.0, "albedo": 0.8}
        result["small-box"] = small | {"bsdf": {"type": "null"}, "interior": fog}
    size = {"width": 4, "height": 4, "rfilter": {"type": "box"}}
    if kind == "phasors":
        result["sensor"]["film"] = size | {"type": "phasor_hdr_film", "frequencies": "0, 0.5, 1"}
    if kind == "gates":
        result["sensor"]["film"] = size | {"type": "gated_hdr_film", "gates": "gaussian 5.0 2.0; gaussian 6.0 2.0"}
    if kind == "pulse":
        result["sensor"]["film"] = result["sensor"]["film"] | {"pulse": "gaussian", "pulse_fwhm_opl": 0.5}
    if kind == "thin glass":  # its lobes hide the derivative of their probability
        result["small-box"] = small | {"bsdf": {"type": "thindielectric"}}
    if kind == "mixture":
        blend = {"type": "blendbsdf", "weight": 0.4, "a": {"type": "diffuse"}, "b": {"type": "conductor"}}
        result["small-box"] = small | {"bsdf": {"type": "mask", "opacity": 0.7, "nested": blend}}
    if kind == "sphere light":
        result["light"] = {"type": "sphere", "center": [0, 0.5, 0], "radius": 0.2, "emitter": {"type": "area"}}
    if kind == "delayed":
        result["small-box"] = small | {"bsdf": {"type": "delayed", "lifetime": 0.3, "nested": {"type": "diffuse"}}}
    if kind == "coating":  # its tables are no parameters
        result["small-box"] = small | {"bsdf": {"type": "diff_rough_plastic", "alpha": 0.3}}
    if kind == "lobes":  # another plugin, which it asks, is no parameter
        result["small-box"] = small | {"bsdf": {"type": "diff_principled", "spec_trans": 0.5, "clearcoat": 0.5}}
    return result


KINDS = (
    "surfaces", "media", "phasors", "gates", "pulse", "thin glass", "delayed", "mixture", "coating",
    "lobes", "sphere light",
)  # fmt: skip


def render(scene, params, x, adjoint, seed):
    with dr.suspend_grad():
        return scene.integrator().render(scene, seed=seed, spp=4, evaluate=False)


def backward(scene, params, x, adjoint, seed):
    x = type(x)(x)
    dr.enable_grad(x)
    params[KEY] = x
    params.update()
    scene.integrator().render_backward(scene, params, (None, adjoint), seed=seed, spp=4)
    return dr.grad(x)


def forward(scene, params, x, adjoint, seed):
    x = type(x)(x)
    dr.enable_grad(x)
    dr.set_grad(x, 1)
    params[KEY] = x
    params.update()
    return scene.integrator().render_forward(scene, params, seed=seed, spp=4)


def arrays(value):
    return [np.array(v) for v in (value if isinstance(value, tuple) else (value,))]


RUNS = (render, backward, forward)
# Each kind in one mode.
PAIRS = [("media", backward), *((kind, RUNS[n % 3]) for n, kind in enumerate(KINDS) if kind != "media")]


@pytest.mark.parametrize(("kind", "run"), long_rows(PAIRS, PAIRS[:1]))
def test_one_recording_for_all_seeds(kind, run):
    scene = mi.load_dict(scene_of(kind), optimize=False)
    params, shape = mi.traverse(scene), scene.sensors()[0].film().cube_shape()
    entries = np.cos(np.arange(int(np.prod(shape)))).astype(np.float32).reshape(shape)
    adjoint, x = mi.TensorXf(entries), type(params[KEY])(params[KEY])

    def call(scene, x, adjoint, seed):
        return run(scene, params, x, adjoint, seed)

    frozen = dr.freeze(call, state_fn=lambda scene, *_: scene.integrator().frozen_state(scene))
    # Atomic sums differ in the last digit from run to run; everything else is the same kernel.
    seen, recordings = [], []
    for seed in (0, 1, 5, 9, 13):
        with no_collection():  # recording traces outside of the integrator, too
            # Traced for the first, for one that is launched, and for the last.
            expected = arrays(call(scene, x, adjoint, dr.opaque(mi.UInt32, seed))) if seed in (0, 5, 13) else None
            got = arrays(frozen(scene, x, adjoint, dr.opaque(mi.UInt32, seed)))
        expected = expected or got
        for a, b in zip(expected, got, strict=True):
            np.testing.assert_allclose(b, a, rtol=1e-5, atol=1e-6 * np.abs(a).max())
        seen.append(expected[-1])
        recordings.append(frozen.n_recordings)
    # What the call before left in the film can be another layout of the inputs; seeds are none.
    assert recordings[-1] <= 2
    assert not np.allclose(seen[0], seen[1])


def hashes(scene, **call):
    """Hashes of the kernels of a render."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        dr.eval(scene.integrator().render(scene, **call))
        return [entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])]


@pytest.mark.parametrize("kind", long(["media", "phasors"], ["media"]))
def test_numbers_of_a_call_are_no_literals(kind, monkeypatch):
    """Other seeds, other rows and other numbers of samples find the same kernels."""
    scene = mi.load_dict(scene_of(kind), optimize=False)
    first = hashes(scene, seed=0, spp=16)
    assert hashes(scene, seed=1, spp=16) == first
    assert hashes(scene, seed=np.uint32(7), spp=16) == first
    assert hashes(scene, seed=0, spp=64) == first
    # Several launches: rows and samples of each in turn.
    monkeypatch.setattr("torchtransient.plugins.integrators.job.MAX_LANES", 4 * 2 * 16)
    parts = hashes(scene, seed=0, spp=16)
    assert len(parts) > len(first) and len(set(parts)) == len(first)

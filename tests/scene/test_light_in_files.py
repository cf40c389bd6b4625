"""Response curves, pulses, gates and delays as scene files say them, and through the command line."""

from __future__ import annotations

import pytest
import torch

import torchtransient as tt

VARIANT = 'llvm_ad_mono'

SCENE = """<scene version="3.0.0">
    <integrator type="transient_path"><integer name="max_depth" value="3"/></integrator>
    <sensor type="perspective">
        <float name="fov" value="10"/>
        <transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
        <sampler type="independent"><integer name="sample_count" value="256"/></sampler>
        <film type="{film}">
            <integer name="width" value="2"/><integer name="height" value="2"/>
            <rfilter type="box"/>
            {properties}
        </film>
    </sensor>
    <emitter type="point"><point name="position" x="0.5" y="0" z="4"/><spectrum name="intensity" value="10"/></emitter>
    <shape type="rectangle">{bsdf}</shape>
</scene>"""
DIFFUSE = '<bsdf type="diffuse"><spectrum name="reflectance" value="0.5"/></bsdf>'
AXIS = """<float name="start_opl" value="7"/><float name="bin_width_opl" value="0.02"/>
            <integer name="temporal_bins" value="200"/>"""


@pytest.fixture
def write(tmp_path):
    def write_scene(film="transient_hdr_film", properties=AXIS, bsdf=DIFFUSE):
        path = tmp_path / "scene.xml"
        path.write_text(SCENE.format(film=film, properties=properties, bsdf=bsdf), encoding="utf-8")
        return path

    return write_scene


def mean_opl(out):
    rows = out.transient.sum((0, 2, 3)).double()
    return float((rows * out.axis.centers_opl).sum() / rows.sum())


def test_response_curves(write):
    curves = '<spectrum name="far" value="650:0, 700:1, 750:0"/><spectrum name="near" value="400:0, 450:2, 500:0"/>'
    out = tt.render(tt.load(write(properties=AXIS + curves), variant="llvm_ad_spectral"), seed=0)
    assert out.channels == ("far", "near") and out.transient.shape == (2, 200, 2, 2)
    # a flat lamp and a flat wall: the channels are in the ratio of the areas of their curves
    assert float(out.steady[1].mean() / out.steady[0].mean()) == pytest.approx(2, rel=0.1)


def test_pulse_and_response(write):
    plain = tt.render(tt.load(write(), variant="llvm_ad_mono"), seed=0)
    pulses = """<string name="pulse" value="tabulated"/><string name="pulse_opl" value="0, 0.4"/>
        <string name="pulse_values" value="1 1"/><string name="irf" value="gaussian"/>
        <float name="irf_fwhm_opl" value="0.1"/><float name="irf_center_opl" value="0.3"/>"""
    spread = tt.render(tt.load(write(properties=AXIS + pulses), variant="llvm_ad_mono"), seed=0)
    assert mean_opl(spread) == pytest.approx(mean_opl(plain) + 0.5, abs=1e-3)
    pulse = tt.Pulse.tabulated([0, 0.4], [1, 1]), tt.Pulse.gaussian(0.1, 0.3)
    twin = tt.render(tt.load(write(), variant="llvm_ad_mono"), seed=0, pulse=pulse[0], irf=pulse[1])
    torch.testing.assert_close(twin.transient, spread.transient)


def test_gates(write):
    gates = '<string name="gates" value="rectangular 8.0 8.1; gaussian 8.05 0.05"/>'
    path = write("gated_hdr_film", gates)
    out = tt.render(tt.load(path, variant="llvm_ad_mono"), seed=0)
    assert out.gated.shape == (1, 2, 2, 2) and out.gates[0] == tt.Gate.rectangular(8.0, 8.1)
    twin = tt.render(tt.load(write(), variant="llvm_ad_mono"), seed=0, gates=out.gates)
    torch.testing.assert_close(twin.gated, out.gated)
    assert out.gated.min() > 0


def test_delays(write):
    late = f"""<bsdf type="delayed"><float name="lifetime_s" value="1e-9"/>
        <float name="quantum_yield" value="0.5"/>{DIFFUSE}</bsdf>"""
    plain = tt.render(tt.load(write(), variant="llvm_ad_mono"), seed=0, spp=1 << 14)
    delayed = tt.render(tt.load(write(bsdf=late), variant="llvm_ad_mono"), seed=0, spp=1 << 14)
    # the axis ends 10 lifetimes after the first light
    assert mean_opl(delayed) == pytest.approx(mean_opl(plain) + 0.299792, rel=2e-3)
    assert float(delayed.steady.sum()) == pytest.approx(0.5 * float(plain.steady.sum()), rel=1e-3)

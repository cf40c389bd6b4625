"""`torchtransient nlos`: files in, captures out, and on again after a kill."""

from __future__ import annotations

import json
import os
import signal

import h5py
import numpy as np
import pytest
import torch
from click.testing import CliRunner

import torchtransient as tt
from support.generation_runs import start_command, wait_until
from support.marks import long
from support.sweeps import together
from torchtransient.__main__ import main

VARIANT = "llvm_ad_mono"
OWN = """
hidden:
  plate: {shape: rectangle, scale: 0.3, rotate: [[0, 1, 0], 180], translate: [0.1, 0, 0.9], albedo: 0.7}
wall: {width: 2.0, height: 1.6, albedo: 0.9}
scan: {kind: %s, size: [4, 3]}
time_axis: {start_opl: 1.7, bin_width_opl: 0.02, num_bins: 60}
spp: 16
seed: 5
"""
TAL = """
name: plate
integrator_filter_bounces: 2
sample_count: 16
num_bins: 60
bin_width_opl: 0.02
start_opl: 1.7
scan_type: confocal
sensor_width: 4
sensor_height: 3
geometry:
- name: plate
  mesh: {type: rectangle}
  displacement_z: 0.9
  rot_degrees_y: 180
  scale_x: 0.3
  scale_y: 0.3
  material: {id: white}
- name: wall
  mesh: {type: rectangle}
  material: {id: white}
relay_wall: wall
"""
XML = """<scene version="3.0.0">
  <default name="res" value="3"/>
  <integrator type="transient_nlos_path">
    <string name="capture_type" value="confocal"/><integer name="filter_bounces" value="3"/>
    <integer name="max_depth" value="4"/>
    <boolean name="nlos_laser_sampling" value="true"/><boolean name="nlos_hidden_geometry_sampling" value="true"/>
  </integrator>
  <emitter type="laser_beam"><transform name="to_world"><translate x="-0.5" z="0.25"/></transform></emitter>
  <shape type="rectangle" id="plate"><transform name="to_world">
    <scale value="0.3"/><rotate y="1" angle="180"/><translate z="0.9"/></transform></shape>
  <shape type="rectangle" id="wall">
    <sensor type="nlos_capture_meter">
      <point name="sensor_origin" x="-0.5" y="0" z="0.25"/>
      <sampler type="independent"><integer name="sample_count" value="16"/></sampler>
      <film type="transient_hdr_film">
        <integer name="width" value="$res"/><integer name="height" value="2"/><rfilter type="box"/>
        <integer name="temporal_bins" value="60"/>
        <float name="start_opl" value="1.7"/><float name="bin_width_opl" value="0.02"/>
      </film>
    </sensor>
  </shape>
</scene>"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.yaml").write_text(OWN % "confocal")
    (tmp_path / "tal.yaml").write_text(TAL)
    (tmp_path / "scene.xml").write_text(XML)
    return tmp_path


def same(a, b):
    """To the rounding of sums that threads add to in the order they come."""
    torch.testing.assert_close(a, b, rtol=0, atol=1e-6 * float(b.abs().max()))


def run(*arguments):
    return CliRunner().invoke(main, ["nlos", *map(str, arguments)])


@pytest.mark.parametrize("kind", long(["single", "exhaustive"], ["single"]))
def test_a_capture_of_a_description(folder, kind):
    """Options replace what the file says."""
    (folder / "own.yaml").write_text(OWN % kind)
    result = run("own.yaml", "--parts", 3, "--spp", 8, "--quiet")
    assert result.exit_code == 0, result.output
    found = tt.nlos.read_capture("own.h5")
    expected = tt.nlos.simulate(**tt.nlos.read_setup("own.yaml") | {"spp": 8}, tiles=3, progress=False)
    same(found.transient, expected.transient)
    assert found.scan == expected.scan
    assert found.metadata["scene"] == "own.yaml" and found.metadata["seed"] == 5 and found.metadata["spp"] == 8
    sizes = " x ".join(map(str, expected.transient.shape))
    assert f"own.h5: {sizes} (C x T x " in result.stdout
    assert sorted(os.listdir(folder)) == ["own.h5", "own.yaml", "scene.xml", "tal.yaml"]


def test_a_device_counts_with_the_seed_of_the_file(folder):
    response = {"kind": "GaussianResponse", "fwhm_s": 1e-10}
    stages = [
        {"kind": "ImpulseResponse", "response": response, "axis": "@axis"},
        {"kind": "SynchronousSPAD", "cycles": 1000},
    ]
    device = {"name": "d", "description": "a detector", "sources": ["assumed: all of it"], "stages": stages}
    (folder / "own.yaml").write_text(OWN % "confocal" + f"sensor: {json.dumps(device)}\n")
    for name in ("a.h5", "b.h5"):
        assert run("own.yaml", "-o", name, "--whole", "--quiet").exit_code == 0
    assert run("own.yaml", "-o", "c.h5", "--whole", "--quiet", "--seed", 6).exit_code == 0
    a, b, c = (tt.nlos.read_capture(f"{name}.h5").transient for name in "abc")
    assert torch.equal(a, b) and not torch.equal(a, c) and torch.equal(a, a.round())


def test_scenes_of_y_tal(folder):
    result = run("tal.yaml", "--whole", "--quiet")
    assert result.exit_code == 0, result.output
    found = tt.nlos.read_capture("tal.h5")
    setup = tt.nlos.read_setup("tal.yaml")
    assert setup["bounces"] == (3,) and setup["energy"] == 1.0 and setup["variant"] is None
    assert found.transient.shape == (1, 60, 3, 4) and float(found.transient.sum()) > 0
    # The entries of both languages mean the same scene: of other albedos, and moved.
    own = tt.nlos.read_setup("own.yaml")
    own["hidden"]["plate"] |= {
        "to_world": setup["hidden"]["plate"]["to_world"],
        "bsdf": {"type": "diffuse", "reflectance": 1.0},
    }
    own |= {"scan": setup["scan"], "seed": 0}
    expected = tt.nlos.simulate(**own, progress=False)
    torch.testing.assert_close(found.transient, expected.transient, rtol=1e-4, atol=1e-9)


def test_scenes_of_mitsuba(folder):
    result = run("scene.xml", "-o", "a.h5", "--param", "res=5", "--parts", 2, "--quiet")
    assert result.exit_code == 0, result.output
    found = tt.nlos.read_capture("a.h5")
    assert found.transient.shape == (1, 60, 2, 5) and found.scan.kind == "confocal"
    expected = tt.nlos.simulate(tt.load("scene.xml", res=5), tiles=2, progress=False)
    same(found.transient, expected.transient)
    assert found.metadata["parameters"] == ["res=5"] and "share" in found.metadata["light"]


def test_describe_says_what_comes_and_stops(folder):
    result = run("own.yaml", "--describe")
    assert result.exit_code == 0, result.output
    for words in ("Scan(confocal, 4 x 3 points", "1 x 60 x 3 x 4", "variant: llvm_ad_mono", "light of three bounces"):
        assert words in result.stdout
    assert not list(folder.glob("own.h5*"))


@pytest.mark.slow
def test_pictures(folder):
    names = {"--transients": "t.png", "--peak-time": "p.png", "--layout": "l.png", "--video": "v.gif"}
    result = run("own.yaml", "--whole", "--quiet", "--every", 10, *(word for pair in names.items() for word in pair))
    assert result.exit_code == 0, result.output
    for name in names.values():
        assert (folder / name).stat().st_size > 1000 and f"{name}: " in result.stdout


@together("arguments, word", [
    (("own.yaml", "-o", "a.exr"), ".h5"), (("own.yaml", "-o", "no/a.h5"), "'no'"), (("no.yaml",), "no.yaml"),
    (("own.yaml", "--param", "a=1"), "XML files alone"), (("own.txt",), "YAML"),
    (("own.yaml", "--variant", "scalar_rgb"), "scalar_rgb"), (("own.yaml", "--layout", "a.xyz"), "--layout"),
    (("own.yaml", "--peak-time", "no/a.png"), "--peak-time"), (("neither.yaml",), "'geometry'"),
    (("own.yaml", "--whole", "--restart"), "--restart"), (("own.yaml", "--part", "tal.yaml", "--restart"), "part file"),
])  # fmt: skip
def test_mistakes_are_said_before_anything_is_rendered(folder, arguments, word):
    (folder / "neither.yaml").write_text("things: 1")
    result = run(*arguments, "--quiet")
    assert result.exit_code == 2 and word in result.stderr, result.output
    assert not list(folder.glob("*.h5*")) and (folder / "tal.yaml").read_text() == TAL


# ------------------------------------------------------------------------------------------------------------- kills

MANY = ("nlos", "own.yaml", "-o", "a.h5", "--parts", "6", "--spp", "600000", "--quiet")


def finished_parts(part):
    return json.loads(part.read_text())["done"] if part.exists() else {}


@pytest.mark.slow
@pytest.mark.parametrize("signal_name", ["SIGKILL", "SIGINT"])
def test_a_killed_simulation_goes_on(folder, signal_name):
    """Killed in the middle, with whatever was being written; the second call ends with the same bits."""
    part = folder / "a.h5.part"
    child = start_command(folder, *MANY)
    try:
        wait_until(lambda: len(finished_parts(part)) >= 2, 120)
        child.send_signal(signal.SIGSTOP)  # or it may end before the next lines, which compile kernels
        # A second one on the same part file is refused while the first one works.
        other = run(*MANY[1:])
        assert other.exit_code == 2 and "another process works on" in other.stderr
        child.send_signal(getattr(signal, signal_name))
        child.send_signal(signal.SIGCONT)
        _, told = child.communicate(timeout=60)
    finally:
        child.kill()
        child.wait()
    kept = finished_parts(part)
    assert 2 <= len(kept) < 6 and not (folder / "a.h5").exists()
    if signal_name == "SIGINT":
        assert child.returncode == 130 and "the same command goes on" in told
    rows = np.load(f"{part}.npy").copy()
    result = run(*MANY[1:])
    assert result.exit_code == 0, result.output
    found = tt.nlos.read_capture(folder / "a.h5")
    setup = tt.nlos.read_setup(folder / "own.yaml") | {"spp": 600000}
    expected = tt.nlos.simulate(**setup, tiles=6, progress=False)
    same(found.transient, expected.transient)
    first = [number for number, count, _ in kept.values() for number in range(number, number + count)]
    cube = found.transient.flatten(2)[0].T.numpy()
    np.testing.assert_array_equal(rows[first, :60], cube[first])
    assert sorted(p.name for p in folder.glob("a.h5*")) == ["a.h5"]


@pytest.mark.slow
def test_a_part_file_of_other_settings(folder, monkeypatch):
    from torchtransient.nlos.simulation import HiddenWork

    real = HiddenWork.render
    with monkeypatch.context() as patch:
        patch.setattr(HiddenWork, "render", lambda self, n, *a, **k: real(self, n, *a, **k) if n < 2 else _stop())
        result = run("own.yaml", "--parts", 3, "--quiet")
    assert result.exit_code == 130 and "kept in own.h5.part: the same command goes on" in result.stderr
    result = run("own.yaml", "--parts", 3, "--quiet", "--seed", 1)
    assert result.exit_code == 2 and "belongs to another simulation" in result.stderr
    assert len(finished_parts(folder / "own.h5.part")) == 2
    result = run("own.yaml", "--parts", 3, "--quiet", "--seed", 1, "--restart")
    assert result.exit_code == 0 and not (folder / "own.h5.part").exists()


def test_an_output_that_cannot_be_written_keeps_the_parts(folder, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(h5py.Group, "create_dataset", full)
        result = run("own.yaml", "--parts", 3, "--quiet")
    assert result.exit_code == 2 and "No space left" in result.stderr
    assert len(finished_parts(folder / "own.h5.part")) == 3
    assert run("own.yaml", "--parts", 3, "--quiet").exit_code == 0


def _stop():
    raise KeyboardInterrupt

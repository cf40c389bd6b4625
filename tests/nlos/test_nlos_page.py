"""docs/nlos.md: its blocks run in the order that they stand in, its files and commands are taken, its names exist."""

from __future__ import annotations

import inspect
import re

import pytest
import torch
from click.testing import CliRunner

import torchtransient as tt
from support.pages import Page
from torchtransient.cli.main import main

VARIANT = "llvm_ad_mono"
PAGE = Page("docs/nlos.md")
TEXT = PAGE.text
# What makes captures small.
SMALLER = {r"\(64, 64\)": "(4, 4)", r"\(8, 8\)": "(2, 2)", r"spp=\d+": "spp=8", r"range\(100\)": "range(2)"}
SCENE = """<scene version="3.0.0">
  <default name="res" value="4"/>
  <integrator type="transient_nlos_path"><integer name="max_depth" value="3"/>
    <string name="capture_type" value="confocal"/>
    <boolean name="nlos_laser_sampling" value="true"/><boolean name="nlos_hidden_geometry_sampling" value="true"/>
  </integrator>
  <emitter type="laser_beam"/>
  <shape type="rectangle"><transform name="to_world">
    <scale value="0.4"/><rotate y="1" angle="180"/><translate z="1"/></transform></shape>
  <shape type="rectangle" id="relay_wall">
    <sensor type="nlos_capture_meter">
      <sampler type="independent"><integer name="sample_count" value="8"/></sampler>
      <point name="sensor_origin" x="-0.5" y="0.0" z="0.25"/><point name="laser_origin" x="-0.5" y="0.0" z="0.25"/>
      <film type="transient_hdr_film">
        <integer name="width" value="$res"/><integer name="height" value="$res"/>
        <integer name="temporal_bins" value="200"/>
        <float name="bin_width_opl" value="0.02"/><float name="start_opl" value="1.85"/><rfilter type="box"/>
      </film>
    </sensor>
  </shape>
</scene>"""
OBJ = "v -0.1 -0.1 0\nv -0.1 0.1 0\nv 0.1 0.1 0\nf 1 2 3\n"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """With the files that the page speaks of."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "part.obj").write_text(OBJ)
    (yaml,) = PAGE.blocks("yaml")
    yaml = yaml.replace("[32, 32]", "[4, 4]").replace("spp: 4096 ", "spp: 8 ")
    (tmp_path / "capture.yaml").write_text(yaml)
    made = re.search(r"# (tt\.sensing.*to_yaml.*)", yaml)
    exec(made[1], {"tt": tt})
    return tmp_path


@pytest.mark.slow
def test_every_block_runs(folder):
    """In one session from top to bottom."""
    names = PAGE.names(SMALLER)
    for written in ("k.h5", "layout.png", "fit.pt"):
        assert (folder / written).stat().st_size > 500
    assert names["capture"].transient.shape[2:] == (4, 4) and float(names["capture"].total().sum()) > 0
    assert names["every"].shape == (2, 2, 4, 4) and names["some"].shape == names["pairs"].shape == (2,)
    assert not torch.equal(names["leaf"], names["scan"].sensor_points)
    assert set(torch.load("fit.pt", weights_only=False)) == {"renderer", "points"}
    renderer = tt.nlos.CaptureRenderer(names["hidden"], names["scan"], ["letter.to_world"])
    assert list(renderer.state_dict()) == ["renderer.letter/to_world"]
    assert renderer(seed=0).metadata["spp"] == 4


@pytest.mark.slow
def test_the_commands_are_what_python_does(folder):
    """Sixteen parts and the seed's noise."""
    for line in PAGE.blocks("sh")[0].splitlines():
        words = line.split("#")[0].split()
        assert words[:2] == ["torchtransient", "nlos"]
        words = [word for word in words[1:] if not word.endswith(".mp4") and word != "--video"]
        result = CliRunner().invoke(main, words)
        assert result.exit_code == 0, result.output
    written = tt.nlos.read_capture("capture.h5")
    setup = tt.nlos.read_setup("capture.yaml")
    generator = torch.Generator().manual_seed(setup["seed"])
    capture = tt.nlos.simulate(**setup, tiles=16, generator=generator, progress=False)
    assert torch.equal(capture.transient, written.transient)
    assert tt.nlos.read_capture("capture.npz").metadata["spp"] == 1000


@pytest.mark.slow
def test_surfaces_face_the_wall():
    """As the page says: rectangles of Mitsuba look away from a wall that looks along +z."""
    scan = tt.nlos.Scan.grid(tt.nlos.Wall.plane(2.0, 2.0), 2, kind="confocal")
    away = {"type": "rectangle", "to_world": tt.scenes.transforms.translate([0.0, 0.0, 1.0])}
    turned = {"to_world": away["to_world"] @ tt.scenes.transforms.rotate([0, 1, 0], 180)}
    twosided = re.search(r'`"bsdf": (\{.*\})`', TEXT)[1]
    with pytest.warns(tt.errors.PhysicsWarning, match="no light comes back"):
        tt.nlos.simulate(away, scan, spp=16, progress=False)
    found = [
        tt.nlos.simulate(away | change, scan, spp=256, progress=False).steady.sum()
        for change in (turned, {"flip_normals": True}, {"bsdf": eval(twosided)})
    ]
    torch.testing.assert_close(torch.stack(found), found[0].expand(3), rtol=0.02, atol=0)


def test_the_package_lists_its_names():
    named = set(re.findall(r"^- `(\w+)`(?:, `(\w+)`)?", tt.nlos.__doc__, flags=re.MULTILINE))
    there = {name for name, value in vars(tt.nlos).items() if name[0] != "_" and not inspect.ismodule(value)}
    assert {name for pair in named for name in pair if name} == there

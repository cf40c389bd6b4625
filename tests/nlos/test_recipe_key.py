"""Part files belong to the files that a complete scene names, wherever it names them."""

from __future__ import annotations

import pytest

import torchtransient as tt
from torchtransient.errors import StorageError

VARIANT = "llvm_ad_mono"
MESH = "v -0.4 -0.4 {z}\nv -0.4 0.4 {z}\nv 0.4 0.4 {z}\nf 1 2 3\n"
SCENE = """<scene version="3.0.0">
  <integrator type="transient_nlos_path">
    <string name="capture_type" value="confocal"/><integer name="max_depth" value="3"/>
    <boolean name="nlos_laser_sampling" value="true"/><boolean name="nlos_hidden_geometry_sampling" value="true"/>
  </integrator>
  <emitter type="laser_beam"/>
  {named}
  <shape type="rectangle" id="wall">
    <sensor type="nlos_capture_meter">
      <point name="sensor_origin" x="-0.5" y="0.0" z="0.25"/><point name="laser_origin" x="-0.5" y="0.0" z="0.25"/>
      <sampler type="independent"><integer name="sample_count" value="4"/></sampler>
      <film type="transient_hdr_film">
        <integer name="width" value="2"/><integer name="height" value="2"/><integer name="temporal_bins" value="20"/>
        <float name="bin_width_opl" value="0.1"/><float name="start_opl" value="1.9"/><rfilter type="box"/>
      </film>
    </sensor>
  </shape>
</scene>"""
BSDF = '<bsdf type="twosided"><bsdf type="diffuse"/></bsdf>'
SHAPE = f'<shape type="obj"><string name="filename" value="{{name}}"/>{BSDF}</shape>'
ROUTES = {
    "in a folder by a parameter": (SHAPE.format(name="$place/a.obj"), {"place": "deep"}, "deep/a.obj"),
    "in an included file": ('<include filename="more.xml"/>', {}, "default.obj"),
}


@pytest.mark.slow
@pytest.mark.parametrize("route", ROUTES)
def test_a_mesh_that_changed_is_another_simulation(tmp_path, route):
    named, parameters, mesh = ROUTES[route]
    (tmp_path / "deep").mkdir()
    for name in ("default.obj", "deep/a.obj", "a.obj"):
        (tmp_path / name).write_text(MESH.format(z=1))
    (tmp_path / "more.xml").write_text(f'<scene version="3.0.0">{SHAPE.format(name="default.obj")}</scene>')
    (tmp_path / "scene.xml").write_text(SCENE.format(named=named))
    settings = {"part": tmp_path / "a.part", "tiles": 2, "keep_part": True, "progress": False}

    def capture(**given):
        return tt.nlos.simulate(tt.load(tmp_path / "scene.xml", **parameters | given), **settings).transient

    first = capture()
    assert float(first.sum()) > 0 and bool((capture() == first).all())
    (tmp_path / mesh).write_text(MESH.format(z=1.05))
    with pytest.raises(StorageError, match="belongs to another simulation"):
        capture()
    (tmp_path / mesh).write_text(MESH.format(z=1))
    if parameters:  # another file of the same contents
        with pytest.raises(StorageError, match="belongs to another simulation"):
            capture(place=".")

"""Keys are the same in every process: nothing is called after an address in memory."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.small_room import VARIANT, make_room

MERGED = """<scene version="3.0.0">
<integrator type="transient_path"/>
<sensor type="perspective"><film type="transient_hdr_film"><integer name="width" value="2"/>
<integer name="height" value="2"/><integer name="temporal_bins" value="4"/></film></sensor>
<shape type="shapegroup" id="group"><shape type="merge"><shape type="cube"/>
<shape type="cube"><transform name="to_world"><translate x="2"/></transform><bsdf type="diffuse"/></shape>
</shape></shape>
<shape type="merge"><shape type="cube"><bsdf type="conductor"/></shape>
<shape type="merge"><shape type="cube" id="mine"><transform name="to_world"><translate x="3"/></transform>
<bsdf type="diffuse"/></shape></shape></shape>
<shape type="sphere"/>
<emitter type="constant"/>
</scene>"""


@pytest.fixture
def merged_file(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(MERGED)
    return path


def test_merged_shapes_have_names_and_transforms(merged_file):
    scene = tt.load(merged_file, variant=VARIANT)
    table = scene.parameters()
    assert not [key for key in table if "object_" in key]
    shapes = [key.rsplit(".", 1)[0] for key in table if key.endswith(".vertex_positions")]
    assert sorted(shapes) == ["group.shape", "group.shape_1", "mine", "shape_0_0"]
    moved = {shape: float(table[f"{shape}.to_world"].value[0, 3]) for shape in shapes}
    assert moved == {"group.shape": 0.0, "group.shape_1": 2.0, "shape_0_0": 0.0, "mine": 3.0}
    assert "shape_1.to_world" in table
    for shape in shapes:
        offset = float(np.mean(table[f"{shape}.vertex_positions"].value[:, 0]))
        assert offset == pytest.approx(moved[shape], abs=1e-6)


@pytest.mark.slow
def test_keys_and_states_are_those_of_another_process(merged_file):
    code = f"import torchtransient as tt; print(*tt.load({str(merged_file)!r}, variant={VARIANT!r}).parameters())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    scene = tt.load(merged_file, variant=VARIANT)
    assert done.stdout.split() == list(scene.parameters())
    key = "shape_0_0.vertex_positions"
    first, second = (tt.TransientRenderer(tt.load(merged_file, variant=VARIANT), parameters=[key]) for _ in range(2))
    second.load_state_dict(first.state_dict())


@pytest.mark.slow
def test_shared_textures_that_become_other_objects():
    """Their keys are no addresses, and the derivative is that of both places together."""
    texture = {"type": "bitmap", "data": np.full((2, 2, 3), 0.4, np.float32), "raw": True}
    ref = {"type": "ref", "id": "ours"}

    def room(*surfaces, **more):
        scene = make_room()
        for name, reflectance in zip(("wall", "box"), surfaces, strict=True):
            scene[name] = scene[name] | {"bsdf": {"type": "diffuse", "reflectance": reflectance}}
        return tt.load({**more, **scene}, variant=VARIANT)

    def slopes(scene, *keys):
        renderer = tt.TransientRenderer(scene, parameters=list(keys), spp=64, grad_seed="same")
        renderer(seed=0).steady.sum().backward()
        return sum(renderer.values[k].grad for k in keys)

    shared = room(ref, ref, first={"type": "uniform", "value": 0.2}, ours=texture)
    apart = [f"{name}.bsdf.reflectance.data" for name in ("wall", "box")]
    expected = slopes(room(texture, texture), *apart)
    torch.testing.assert_close(slopes(shared, "ours.data"), expected, rtol=1e-4, atol=1e-5)

"""One mesh is one capture, whichever file it is read from and whoever reads it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchtransient as tt
from torchtransient.errors import SceneError, StorageError
from torchtransient.nlos.scene import mesh_file

VARIANT = "llvm_ad_mono"
AXIS = tt.TimeAxis(1.0, 0.05, 60)
# Two triangles that meet at an angle: interpolated normals would be others than theirs.
CORNERS = np.array([[-0.5, -0.4, 0.9], [0.0, -0.4, 1.1], [0.0, 0.4, 1.1], [0.5, -0.4, 0.9]])
FACES = np.array([[0, 2, 1], [1, 2, 3]])
HEADER = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
{normals}element face 2
property list uchar int vertex_indices
end_header
"""


def written(folder, ending):
    path = folder / f"mesh{ending}"
    vertices, faces = [" ".join(map(str, v)) for v in CORNERS], [" ".join(map(str, f)) for f in FACES]
    if ending == ".npz":
        np.savez(path, vertices=CORNERS, faces=FACES)
    elif ending == ".ply":  # with normals that are none of its triangles
        header = HEADER.format(normals="property float nx\nproperty float ny\nproperty float nz\n")
        rows = [f"{v} 0.6 0 -0.8" for v in vertices] + [f"3 {f}" for f in faces]
        path.write_text(header + "\n".join(rows) + "\n")
    else:
        lines = [f"v {v}" for v in vertices] + ["f " + " ".join(map(str, f + 1)) for f in FACES]
        path.write_text("\n".join(lines) + "\n")
    return path


def capture(hidden, **settings):
    scan = tt.nlos.Scan.grid(tt.nlos.Wall.plane(), 2, kind="confocal")
    settings = {"time_axis": AXIS, "spp": 64, "progress": False} | settings
    return tt.nlos.simulate(hidden, settings.pop("scan", scan), **settings)


@pytest.mark.slow
@pytest.mark.parametrize("ending", [".obj", ".ply", ".npz"])
def test_files_arrays_and_descriptions_agree(tmp_path, ending):
    path = written(tmp_path, ending)
    expected = capture((CORNERS, FACES)).transient
    text = f"""
hidden: {{mesh: {{file: {path}}}}}
scan: {{kind: confocal, size: 2}}
time_axis: {{start_opl: 1.0, bin_width_opl: 0.05, num_bins: 60}}
spp: 64
"""
    (tmp_path / "a.yaml").write_text(text)
    described = tt.nlos.read_setup(tmp_path / "a.yaml")
    for found in (capture(path), tt.nlos.simulate(**described, progress=False)):
        torch.testing.assert_close(found.transient, expected, rtol=0, atol=1e-5 * float(expected.max()))


def test_files_that_are_no_meshes(tmp_path):
    for route in (lambda path: mesh_file(path, "hidden"), capture):
        for name, error, message in (
            ("a.stl", SceneError, r"expected a mesh file \(\.obj, \.ply, \.serialized, \.npz\)"),
            ("a.xml", SceneError, "leave scan out"), ("a.obj", SceneError, "no file"),
        ):  # fmt: skip
            with pytest.raises(error, match=message):
                route(tmp_path / name)
        (tmp_path / "b.npz").write_bytes(b"nothing")
        with pytest.raises(StorageError, match="'vertices' and 'faces' in"):
            route(tmp_path / "b.npz")


def test_defaults_are_those_of_every_route():
    """Bins of 16 ps, 4096 samples, light around one corner."""
    scan = tt.nlos.Scan.grid(tt.nlos.Wall.plane(), 2, kind="confocal")
    from torchtransient.nlos.setup_files import read_description

    described = read_description("\nhidden: {letter: {scene: nlos_z}}\nscan: {kind: confocal, size: 2}\n")
    forecast = tt.nlos.forecast(tt.scenes.nlos_z(), scan)
    width = tt.units.seconds_to_opl(16e-12)
    assert described.axis.bin_width_opl == width == capture(tt.scenes.nlos_z(), time_axis=None).axis.bin_width_opl
    assert described.spp == forecast.spp == 4096 and described.bounces == (3,)
    assert described.axis == capture(tt.scenes.nlos_z(), time_axis=None).axis

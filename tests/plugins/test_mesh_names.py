"""Arrays of meshes under the names and in the layouts of Mitsuba 3.9 and 3.10."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import pytest
import torch

import torchtransient as tt
from torchtransient import plugins

pytestmark = pytest.mark.filterwarnings("ignore::torchtransient.errors.VersionWarning")


# Names in Mitsuba 3.9, those in Mitsuba 3.10, and columns.
NAMES = {
    "vertex_positions": ("positions", 3),
    "vertex_normals": ("normals", 3),
    "vertex_texcoords": ("texcoords", 2),
    "faces": ("faces", 3),
}


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant("llvm_ad_rgb")
    plugins.sync()


# ----------------------------------------------------------------------------------------- Mitsuba 3.10 in Mitsuba 3.9


class Rows:
    """Handle of an array that is shown as rows: an array of Mitsuba 3.9, or the rows that vertices share."""

    def __init__(self, handle=None, columns=1, value=None):
        self.handle, self.columns, self.value = handle, columns, value


@pytest.fixture
def new_meshes(monkeypatch):
    """Meshes as those of Mitsuba 3.10: other names, rows, no buffers. Returns the rows that their vertices share."""
    old, shared, get, write = mi.Mesh, {}, mi.get_property, mi.set_property
    walk, changed = old.traverse, old.parameters_changed
    users = {new: name for name, (new, _) in NAMES.items()}
    exists = {name: getattr(old, f"has_vertex_{name}") for name in ("normals", "texcoords")}

    class NewNames(mi.TraversalCallback):
        def __init__(self, mesh, callback):
            super().__init__()
            self.mesh, self.callback = mesh, callback

        def put(self, name, value, flags, cpptype=None):
            new, columns = NAMES.get(name, (name, None))
            if new in exists and not exists[new](self.mesh):
                return
            self.callback.put(new, value if columns is None else Rows(value, columns), flags, cpptype)
            if new == "positions":
                for index in ("position_index", "normal_index", "bsdf_index"):
                    self.callback.put(index, Rows(value=shared.get(index, mi.UInt32())), 0, mi.UInt32)

    def get_property(handle, kind, node):
        if not isinstance(handle, Rows):
            return get(handle, kind, node)
        if handle.handle is None:
            return handle.value
        flat = get(handle.handle, kind, node)
        return dr.tensor_t(type(flat))(flat, (dr.width(flat) // handle.columns, handle.columns))

    def set_property(handle, kind, value):
        if not isinstance(handle, Rows):
            return write(handle, kind, value)
        assert dr.is_tensor_v(value) and value.shape[1] == handle.columns
        return write(handle.handle, kind, value.array)

    def parameters_changed(mesh, keys=()):
        changed(mesh, [users.get(name, "unknown" if name in NAMES else name) for name in keys])

    monkeypatch.setattr(mi, "__version__", "3.10.0")
    monkeypatch.setattr(mi, "get_property", get_property)
    monkeypatch.setattr(mi, "set_property", set_property)
    monkeypatch.setattr(old, "traverse", lambda mesh, callback: walk(mesh, NewNames(mesh, callback)))
    monkeypatch.setattr(old, "parameters_changed", parameters_changed)
    for name, method in exists.items():
        monkeypatch.setattr(old, f"has_{name}", method, raising=False)
        monkeypatch.delattr(old, f"has_vertex_{name}")
    for name in NAMES:
        monkeypatch.delattr(old, f"{name}_buffer")
    return shared


# --------------------------------------------------------------------------------------------------------- the library


def scene(face_normals=False):
    return tt.load(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "transient_hdr_film", "width": 4, "height": 4},
            },
            "cube": {"type": "cube", "bsdf": {"type": "diffuse"}, "face_normals": face_normals},
            "light": {"type": "point", "position": [1, 2, 5], "intensity": 10.0},
        }
    )


def derivatives(key, face_normals):
    """Return the table of parameters, a render, and a gradient by ``key``."""
    loaded = scene(face_normals)
    table = {name: info.shape for name, info in loaded.parameters().items() if name.startswith("cube.")}
    axis = tt.TimeAxis(start_opl=6.0, bin_width_opl=0.5, num_bins=12)
    render = tt.TransientRenderer(
        loaded, [key], time_axis=axis, spp=16, max_depth=3, temporal_filter="gaussian"
    )
    value = torch.as_tensor(loaded.parameters()[key].value * 1.01).requires_grad_()
    out = render({key: value}, seed=1)
    steps = torch.arange(out.transient.numel()).reshape(out.transient.shape).float()
    (grad,) = torch.autograd.grad((out.transient * torch.sin(steps)).sum(), value)
    return table, out.transient.detach(), grad


@pytest.mark.slow
@pytest.mark.parametrize(("key", "face_normals"), [("cube.vertex_positions", False), ("cube.to_world", True)])
def test_renders_and_gradients_are_the_same(request, key, face_normals):
    table, image, grad = derivatives(key, face_normals)
    request.getfixturevalue("new_meshes")
    assert set(mi.traverse(mi.load_dict({"type": "cube"})).keys()) >= {"positions", "normals", "texcoords"}
    new_table, new_image, new_grad = derivatives(key, face_normals)
    assert {k: shape for k, shape in new_table.items() if not k.endswith(("faces", "_index"))} == {
        k: shape for k, shape in table.items() if not k.endswith("faces") and (shape == () or shape[0] > 0)
    }
    assert image.abs().sum() > 0 and grad.abs().sum() > 0
    torch.testing.assert_close(new_image, image)
    torch.testing.assert_close(new_grad, grad, rtol=1e-4, atol=1e-5)

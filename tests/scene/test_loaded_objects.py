"""Mitsuba objects and scenes that are loaded already: every kind is rendered, listed, differentiated, pickled, taken to
another variant and planned, or refused in words.
"""

from __future__ import annotations

import pickle

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.small_room import COLOUR, make_room, pose

VARIANT = "llvm_ad_rgb"
PIXELS = np.linspace(0.1, 0.9, 48, dtype=np.float32).reshape(4, 4, 3)


def with_surface(entry):
    room = make_room()
    room["wall"]["bsdf"]["reflectance"] = entry
    return room


def bitmap():
    plain = {"type": "bitmap", "raw": True}
    return with_surface(plain | {"bitmap": mi.Bitmap(PIXELS)}), with_surface(plain | {"data": PIXELS})


def grid():
    """A medium in the cube, whose extinction is a grid."""
    values = np.linspace(0.5, 2.0, 24, dtype=np.float32).reshape(2, 3, 4, 1)

    def room(volume):
        found = make_room()
        found["integrator"]["type"] = "transient_prbvolpath"
        sigma = {"type": "gridvolume", "grid": volume, "to_world": pose(0.1, -0.3, 0.2, 0.6)}
        medium = {"type": "heterogeneous", "sigma_t": sigma, "albedo": 0.7}
        found["box"] |= {"bsdf": {"type": "null"}, "interior": medium}
        return found

    return room(mi.VolumeGrid(values)), room(values)


def mesh(**more):
    plain = make_room()
    plain["box"] |= more
    given = make_room()
    given["box"] = mi.load_dict(plain["box"])
    return given, plain


def mirrored_mesh():
    return mesh(to_world=pose(0.4, 0.0, 0.5, 0.3) @ np.diag([1.0, -1.0, 1.0, 1.0]))


def mesh_with_flat_faces():
    return mesh(face_normals=True)


def surface():
    plain = make_room()
    return plain | {"wall": plain["wall"] | {"bsdf": mi.load_dict(plain["wall"]["bsdf"])}}, plain


def sensor():
    plain = make_room()
    return plain | {"sensor": mi.load_dict(plain["sensor"])}, plain


def scene():
    return mi.load_dict(make_room(), optimize=False), make_room()


DESCRIBED = (bitmap, grid, mirrored_mesh, mesh_with_flat_faces)
KEPT = (surface, sensor, scene)
# Keys of what was taken itself; None: that of the scene's coloured box.
KEYS = {
    bitmap: "wall.bsdf.reflectance.data", grid: "box.interior_medium.sigma_t.data",
    mirrored_mesh: "box.vertex_positions", surface: "wall.bsdf.reflectance.value", scene: "light.position",
}  # fmt: skip


def render(loaded, key=None):
    renderer = tt.TransientRenderer(loaded, parameters=[key] if key else [], spp=8, physics="ignore")
    out = renderer(seed=0).transient
    if key:
        weights = torch.linspace(0.5, 1.5, out.shape[1])[None, :, None, None]
        (out * weights).sum().backward()
    return out.detach(), renderer.values[key].grad if key else None


def each(makers, *quick):
    """All kinds, the others than ``quick`` among the slow tests."""
    marks = {make: () if make in quick else pytest.mark.slow for make in makers}
    return pytest.mark.parametrize("make", [pytest.param(m, marks=marks[m], id=m.__name__) for m in makers])


@each([*DESCRIBED, *KEPT], scene)
def test_same_picture_table_and_gradient_as_the_description(make):
    given, plain = make()
    taken, described = tt.load(given), tt.load(plain, variant=VARIANT)
    names = {k: v.differentiable for k, v in taken.parameters().items()}
    # A mesh that keeps no transform is placed by its vertices alone.
    assert names == {k: v.differentiable for k, v in described.parameters().items()}
    key = KEYS.get(make, COLOUR)
    a, b = render(taken, key), render(described, key)
    assert a[0].sum() > 0 and a[1].abs().max() > 0
    torch.testing.assert_close(a[0], b[0], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(a[1], b[1], rtol=1e-4, atol=1e-5)


@each([bitmap, grid, mesh_with_flat_faces])
def test_described_objects_travel(make):
    given, plain = make()
    taken, mono = tt.load(given), "llvm_ad_mono"
    again = pickle.loads(pickle.dumps(taken))
    assert again.same_description(taken) and taken.same_description(tt.load(given))
    assert torch.equal(render(again)[0], render(taken)[0])
    if make is not mesh_with_flat_faces:
        torch.testing.assert_close(
            render(tt.load(taken, variant=mono))[0], render(tt.load(plain, variant=mono))[0], rtol=1e-5, atol=1e-6
        )
        assert tt.plan(taken, pilot=False).variant


@each([surface, scene], scene)
def test_objects_that_are_taken_as_they_are_stay(make):
    given, _ = make()
    taken = tt.load(given)
    assert taken.variant == VARIANT and taken.same_description(tt.load(given))
    for refused in (
        lambda: pickle.dumps(taken),
        lambda: pickle.dumps(tt.TransientRenderer(taken)),
        lambda: tt.load(taken, variant="llvm_ad_mono"),
        lambda: tt.load(given, variant="llvm_ad_mono"),
        lambda: tt.plan(taken, pilot=False),
        lambda: tt.data.Recipe(taken),
    ):
        with pytest.raises(tt.errors.SceneError, match=r"taken as it( is|)(.|\n)*dictionary or an XML file"):
            refused()


def test_what_would_change_a_ready_scene_is_refused():
    loaded = tt.load(mi.load_dict(make_room(), optimize=False))
    axis = tt.TimeAxis(start_opl=6.0, bin_width_opl=0.25, num_bins=24)
    for options in ({"max_depth": 2}, {"steady": False}, {"pulse": tt.Pulse.gaussian(0.5)}):
        with pytest.raises(tt.errors.SceneError, match="was taken as it is"):
            tt.TransientRenderer(loaded, **options)
    with pytest.raises(tt.errors.SceneError, match="time_axis would change"):
        tt.TransientRenderer(loaded, time_axis=tt.TimeAxis(start_opl=6.0, bin_width_opl=0.5, num_bins=24))
    assert tt.TransientRenderer(loaded, time_axis=axis, max_depth=3).axis == axis
    steady = make_room()
    steady["integrator"] = {"type": "direct"}
    with pytest.raises(tt.errors.SceneError, match="DirectIntegrator was taken as it is"):
        tt.TransientRenderer(tt.load(mi.load_dict(steady)))
    steady = make_room()
    steady["sensor"]["film"] = {"type": "hdrfilm", "width": 4, "height": 3, "rfilter": {"type": "mitchell"}}
    with pytest.raises(tt.errors.SceneError, match=r"taken as it is .* no time axis.*Make the scene with a trans"):
        tt.TransientRenderer(tt.load(mi.load_dict(steady)), time_axis=axis)


STEADY_FILM = {"type": "hdrfilm", "width": 6, "height": 4, "rfilter": {"type": "tent"}}
STEADY = {
    "crop": ({}, {"crop_width": 3, "crop_height": 2, "crop_offset_x": 1, "crop_offset_y": 1}, {}),
    "lens": ({"type": "thinlens", "aperture_radius": 0.05, "focus_distance": 3.0}, {}, {"max_depth": 2}),
    "angle": ({"fov_axis": "y", "principal_point_offset_x": 0.1}, {"rfilter": {"type": "box"}}, {"max_depth": -1}),
}


def steady_room(name):
    sensor, film, integrator = STEADY[name]
    room = make_room()
    room["integrator"] = {"type": "path", "max_depth": 3, **integrator}
    room["sensor"] |= {**sensor, "film": STEADY_FILM | film}
    return room


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name == "crop" else pytest.mark.slow) for name in STEADY]
)
def test_a_ready_scene_for_steady_pictures_takes_a_time_axis(name):
    """Its description has the same light in the same bins; the slow rows have derivatives too."""
    keys = [] if name == "crop" else ["light.position"]
    room = steady_room(name)
    axis = tt.TimeAxis(start_opl=6.0, bin_width_opl=0.25, num_bins=24)
    found = []
    for scene in (tt.load(mi.load_dict(room, optimize=False)), tt.load(room, variant=VARIANT)):
        options = {"time_axis": axis, "spp": 9, "physics": "ignore", "max_depth": 4 if name == "angle" else None}
        renderer = tt.TransientRenderer(scene, parameters=keys, temporal_filter="tent", **options)
        out = renderer(seed=0)
        found.append([out.transient.detach(), out.steady.detach()])
        for key in keys:
            out.transient.square().sum().backward()
            found[-1].append(renderer.values[key].grad)
    assert all(one.abs().max() > 0 for one in found[1])
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5 * float(b.abs().max()))

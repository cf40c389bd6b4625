"""Augmented samples are those of a scene and a camera that exist: rendered anew, they are the same."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.marks import long
from support.sweeps import together
from torchtransient import geometry
from torchtransient.data import Affine, Augment, Crop, Flip, Operation, PixelMap, QuarterTurn
from torchtransient.data.augment import KINDS
from torchtransient.errors import ArgumentError, SceneError, ShapeError
from torchtransient.rendering.cameras import camera_of
from torchtransient.rendering.labels import LABELS, NUMBERED, first_return, scene_labels
from torchtransient.scenes import look_at, rotate, scale, translate

VARIANT = "llvm_ad_mono_polarized"
POSE = look_at([0.6, 0.4, 3.0], [0.1, 0.0, 0.0], [0.1, 1.0, 0.0])
N = 12
# In the order of the scene.
WALL, BALL, DROP, BOX = range(4)
# Near its Brewster angle it polarises what it reflects.
ROUGH = {"type": "roughconductor", "alpha": 0.4, "eta": 1.5, "k": 0.3}


def scene_of(pose=POSE, mirror=None, rows=(0, N), columns=(0, N)):
    """A wall that is not frontal, two spheres, a mesh and a light; with a mirror (4, 4) of the world, the mirrored
    scene.
    """
    mirror = np.eye(4) if mirror is None else mirror
    # They are their own mirror images: mirrored before, too, so that what is in front stays there.
    before = np.diag([np.linalg.det(mirror), 1.0, 1.0, 1.0])
    wall = mirror @ translate([0.0, 0.0, -1.0]) @ rotate([0.4, 1.0, 0.2], 25.0) @ scale(6.0) @ before
    ball = mirror @ translate([0.5, 0.3, 0.4]) @ scale(0.4) @ before
    drop = mirror @ translate([-0.4, -0.2, 0.6]) @ scale(0.3) @ before
    box = mirror @ translate([0.4, -0.6, 0.3]) @ rotate([1.0, 0.3, 0.1], 35.0) @ scale(0.3)

    def place(x, y, z):
        return (mirror @ [x, y, z, 1.0])[:3].tolist()

    film = {
        "type": "transient_hdr_film", "width": N, "height": N, "rfilter": {"type": "box"}, "temporal_bins": 40,
        "start_opl": 4.0, "bin_width_opl": 0.2, "crop_width": columns[1] - columns[0], "crop_offset_x": columns[0],
        "crop_height": rows[1] - rows[0], "crop_offset_y": rows[0],
    }  # fmt: skip
    return {
        "type": "scene",
        "integrator": {"type": "transient_path", "max_depth": 2},
        "sensor": {"type": "perspective", "fov": 45.0, "to_world": pose, "film": film},
        "light": {"type": "point", "position": place(-0.4, 1.1, 2.5), "intensity": 20.0},
        "wall": {"type": "rectangle", "to_world": wall, "bsdf": ROUGH},
        "ball": {"type": "sphere", "to_world": ball, "bsdf": {"type": "diffuse"}},
        "drop": {"type": "sphere", "to_world": drop, "bsdf": ROUGH},
        "box": {"type": "cube", "to_world": box, "bsdf": {"type": "diffuse"}},
    }


def sample_of(scene, spp=512):
    renderer = tt.TransientRenderer(tt.load(scene, variant=VARIANT), spp=spp, temporal_filter="tent")
    out, camera = renderer(seed=0), camera_of(renderer)
    found = {"transient": out.transient, "steady": out.steady, **scene_labels(renderer, names=LABELS)}
    found["first_return"] = first_return(out.transient, out.axis, polarized=True)
    found |= {"intrinsics": camera.intrinsics, "to_world": camera.to_world, "index": 7}
    return {name: value.clone() if isinstance(value, torch.Tensor) else value for name, value in found.items()}


@pytest.fixture(scope="module")
def sample():
    return sample_of(scene_of())


def camera_mirror(axis):
    """(4, 4) of the world: the mirror of the camera's x or y."""
    inside = np.diag([-1.0, 1, 1, 1] if axis == "x" else [1.0, -1, 1, 1])
    return POSE @ inside @ np.linalg.inv(POSE)


def turned(quarters):
    """The camera that sees the picture turned counterclockwise by quarters: it has turned clockwise itself."""
    return POSE @ rotate([0.0, 0.0, 1.0], 90.0 * quarters)


def coordinates_of_the_mirrored(uv, shape):
    """Those of wall and spheres, which are mirrored before, run the other way; the box's stay with its corners."""
    u, v = uv
    other_way = torch.where(shape == WALL, 1 - u, (0.5 - u) % 1)
    return torch.stack([torch.where(shape == BOX, u, other_way), v])


# (operation, the scene that its samples show)
CASES = {
    "flip": (Flip(p=1.0), {"mirror": camera_mirror("x")}),
    "vertical flip": (Flip("vertical", 1.0), {"mirror": camera_mirror("y")}),
    "quarter turn": (QuarterTurn(1), {"pose": turned(1)}),
    "half turn": (QuarterTurn(2), {"pose": turned(2)}),
    "three quarters": (QuarterTurn([-1]), {"pose": turned(3)}),
    "crop": (Crop((5, 7), (2, 4)), {"rows": (2, 7), "columns": (4, 11)}),
    "turn and flip": ([QuarterTurn(1), Flip(p=1.0)], {"pose": turned(1), "mirror": camera_mirror("y")}),
}  # fmt: skip


@pytest.mark.parametrize("name", long(["crop", "turn and flip", "half turn"], ["crop", "turn and flip"]))
def test_it_is_the_scene_rendered_anew(sample, name):
    operations, scene = CASES[name]
    found = Augment(operations, polarized=True)(sample)
    known = sample_of(scene_of(**scene))
    assert set(found) == set(sample) and found["index"] == 7
    assert torch.allclose(found["intrinsics"], known["intrinsics"], atol=1e-4)
    assert torch.allclose(found["to_world"], known["to_world"], atol=1e-5)
    if "mirror" in scene:
        found["uv"] = coordinates_of_the_mirrored(found["uv"], found["shape"])
    for label in LABELS:
        a, b = found[label].double(), known[label].double()
        if label == "primitive" and "mirror" in scene:
            # The corners of the wall are others there.
            a, b = (torch.where(found["shape"] == WALL, -2, one) for one in (a, b))
        assert a.shape == b.shape and torch.equal(a.isnan(), b.isnan())
        assert bool(((a - b).abs().nan_to_num() < 1e-4).all()), label
    for light in ("transient", "steady"):
        # Of S3 there is none after one reflection; test_the_field_of_each_pixel_stays has it.
        for k in range(3):
            s, t = (one[light].select(-5 if light == "transient" else -4, k) for one in (found, known))
            # 512 samples of each: smooth but for pixels on edges.
            off = (s - t).norm() / t.norm()
            assert off < 0.05, (light, k, off.item())


def test_all_labels_are_known():
    assert set(LABELS) <= set(KINDS) and "first_return" in KINDS
    assert {name for name, kind in KINDS.items() if kind == "number"} == set(NUMBERED)


@pytest.mark.parametrize("name", CASES)
def test_points_of_the_new_camera(sample, name):
    found = Augment(CASES[name][0], polarized=True)(sample)
    points = geometry.points_from_distance(found["depth"], found["intrinsics"], found["to_world"])
    assert torch.allclose(points, found["position"], atol=2e-5)
    z_depth = geometry.z_depth_from_distance(found["depth"], found["intrinsics"])
    assert torch.allclose(z_depth, found["z_depth"], atol=2e-5)


@pytest.mark.parametrize("k", [0, 1, 2])
def test_affine_maps_of_kornia(sample, k):
    """Points of the new camera lie within the half pixel that the nearest one may be off; a matrix stays one."""
    from kornia.augmentation import RandomAffine, RandomRotation, RandomShear

    affine = RandomAffine(40.0, (0.1, 0.1), (0.7, 1.4), p=1.0)
    kornia = [affine, RandomRotation(60.0, p=1.0), RandomShear(30.0, p=1.0)][k]
    generator = torch.Generator().manual_seed(k)
    state = torch.get_rng_state()
    found = Augment([Affine(kornia), Flip(p=1.0)], polarized=True)(sample, generator=generator)
    assert torch.equal(torch.get_rng_state(), state)
    matrix = found["intrinsics"]
    assert torch.allclose(matrix.tril(-1), torch.zeros(3, 3), atol=1e-4) and bool((matrix.diagonal() > 0).all())
    turn = found["to_world"][:3, :3]
    assert torch.allclose(turn @ turn.mT, torch.eye(3), atol=1e-5) and torch.linalg.det(turn) > 0.99
    points = geometry.points_from_distance(found["depth"], matrix, found["to_world"])
    on_wall = found["shape"] == 0
    assert on_wall.sum() > 20
    off = (points - found["position"]).norm(dim=0)[on_wall]
    # Half a pixel's diagonal of the old image, 45 degrees over 12 pixels, on a wall 4 to 6 m away that is tilted.
    assert off.max() < 6.0 * math.tan(math.radians(22.5)) / 6 * 0.75 * 1.5
    rim = found["shape"] == -1
    assert bool(found["depth"][rim].isnan().all()) and bool((found["material"][rim] == -1).all())
    assert set(found["shape"].unique().tolist()) <= set(sample["shape"].unique().tolist()) | {-1}
    norms = found["normals"].norm(dim=0)[~rim]
    assert torch.allclose(norms, torch.ones_like(norms), atol=1e-5)


def test_light_is_interpolated_bin_by_bin():
    """A picture that is linear in u and v stays so, each bin with its own slope; the sum over bins commutes."""
    from kornia.augmentation import RandomAffine

    v, u = torch.meshgrid(torch.arange(16.0), torch.arange(16.0), indexing="ij")
    cube = torch.stack([u, v, u + 2 * v, 0 * u]).reshape(1, 4, 16, 16)
    augment = Augment(Affine(RandomAffine(30.0, scale=(1.2, 1.3), p=1.0)))
    found = augment({"transient": cube, "steady": cube.sum(1)}, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(found["transient"].sum(1), found["steady"], atol=1e-3)
    first, second, third, none = found["transient"][0]
    assert torch.allclose(third, first + 2 * second, atol=1e-3)
    assert bool((none == 0).all())
    slope = torch.diff(first[5:11, 5:11], dim=1)
    assert slope.std() < 1e-3 and slope.mean() < 0.9


def test_decomposition_of_maps():
    rng = np.random.default_rng(0)
    for _ in range(20):
        matrix = np.eye(3)
        matrix[:2] = rng.normal(size=(2, 3))
        drawn = PixelMap(matrix, (8, 8), (8, 8))
        whole = drawn.rotation @ (np.eye(3) if drawn.mirror is None else drawn.mirror)
        np.testing.assert_allclose(whole @ whole.T, np.eye(3), atol=1e-12)
        upper = matrix[:2, :2] @ whole[:2, :2].T
        assert np.linalg.det(drawn.rotation) > 0 and abs(upper[1, 0]) < 1e-12 and upper[0, 0] > 0 and upper[1, 1] > 0


def test_tuples_batches_and_draws(sample):
    augment = Augment([Flip(), QuarterTurn(), Crop((6, 6))], names=("transient", "depth"))
    pair = (sample["transient"][0], sample["depth"])
    one = augment(pair, generator=torch.Generator().manual_seed(5))
    again = augment(pair, generator=torch.Generator().manual_seed(5))
    assert isinstance(one, tuple) and all(torch.equal(a, b) for a, b in zip(one, again, strict=True))
    batch = tuple(torch.stack([x, 2 * x]) for x in pair)
    both = augment(batch, generator=torch.Generator().manual_seed(5))
    assert torch.equal(both[1][0], one[1]) and torch.equal(both[0][1], 2 * one[0])
    seen = {augment(pair)[1].sum().item() for _ in range(40)}
    assert len(seen) > 20
    batch = {name: torch.stack([value, value]) for name, value in sample.items() if isinstance(value, torch.Tensor)}
    together = Augment(CASES["turn and flip"][0], polarized=True)(batch)
    alone = Augment(CASES["turn and flip"][0], polarized=True)(sample)
    for name, value in together.items():
        assert torch.allclose(value[1].double(), alone[name].double(), atol=1e-5, equal_nan=True), name


FLIP = Augment(Flip(p=1.0))
DEPTH, CUBE = torch.ones(4, 5), torch.ones(1, 3, 4, 5)


@together(
    "call, error, message",
    [
        (lambda: FLIP({"normals": torch.ones(3, 4, 5)}), SceneError, "give to_world="),
        (lambda: FLIP({"depth": DEPTH, "values": {"box.to_world": 1}}), SceneError, "'box.to_world' is not true"),
        (lambda: FLIP({"depth": DEPTH, "transient": CUBE[..., :3]}), ShapeError, "one size"),
        (lambda: FLIP({"index": 3}), SceneError, "got none"),
        (lambda: FLIP({"normals": DEPTH, "to_world": torch.eye(4)}), ShapeError, r"\(\.\.\., 3, H, W\)"),
        (lambda: Augment(Flip(p=1.0), polarized=True)({"transient": CUBE}), ShapeError, "4 Stokes components"),
        (lambda: Augment(QuarterTurn(1), polarized=True)({"steady": torch.ones(4, 1, 4, 5)}), SceneError, "wants intr"),
        (lambda: Augment(Flip(p=1.0), polarized=True)({"measurement": CUBE}), SceneError, "measure afterwards"),
        (lambda: Affine("rotate"), ArgumentError, "of kornia that keeps the size"),
    ],
)  # fmt: skip
def test_what_it_refuses(call, error, message):
    with pytest.raises(error, match=message):
        call()


# ------------------------------------------------------------------------------------------ frames of Stokes components


SIZE = (2, 3)
CAMERAS = torch.tensor([
    [[2.0, 0.0, 0.8], [0.0, 2.0, 0.3], [0.0, 0.0, 1.0]],
    [[1.5, 0.0, 1.9], [0.0, 1.5, 1.1], [0.0, 0.0, 1.0]],
])  # fmt: skip
LEAN = PixelMap([[np.cos(0.5), -np.sin(0.5), 0.2], [np.sin(0.5), np.cos(0.5), -0.1], [0.0, 0.0, 1.0]], SIZE, SIZE)


def frame(ray):
    """The horizontal axis of a pixel's frame and the one that is up, for a ray of kornia's camera."""
    across = np.cross(ray, [0.0, -1.0, 0.0])
    across /= np.linalg.norm(across)
    return across, np.cross(across, ray)


def looked_at_anew(stokes, ray, rotation):
    """The angle of a field, looked at in both frames: the ray before is that of the camera that has not turned."""
    s0, s1, s2, s3 = stokes
    before, up = frame(rotation.T @ ray)
    angle, linear = np.arctan2(s2, s1) / 2, np.hypot(s1, s2)
    field = rotation @ (np.cos(angle) * before + np.sin(angle) * up)
    after, up = frame(ray)
    angle = np.arctan2(field @ up, field @ after)
    return [s0, linear * np.cos(2 * angle), linear * np.sin(2 * angle), s3]


class Lean(Operation):
    def draw(self, size, generator):
        return LEAN


@pytest.mark.parametrize("operation", [QuarterTurn(1), QuarterTurn(3), Lean()])
def test_the_field_of_each_pixel_stays(operation):
    """By batch, channel and bin, with a camera for each entry of the batch; of phasors both parts."""
    light = torch.rand(2, 4, 3, 2, *SIZE, dtype=torch.float64) - 0.4
    sample = {"steady": light[:, :, :, 0], "transient": light, "phasor": torch.complex(light, 2 * light)}
    sample["intrinsics"] = CAMERAS
    found, moved = (Augment(operation, polarized=polarized)(sample) for polarized in (True, False))
    drawn = operation.draw(SIZE, None)
    cameras = drawn.intrinsics(CAMERAS.double())
    for b in range(2):
        for v, u in np.ndindex(drawn.new_size):
            ray = np.linalg.solve(cameras[b].numpy(), [u, v, 1.0])
            ray /= np.linalg.norm(ray)
            for at in np.ndindex(3, 2):
                expected = looked_at_anew(moved["transient"][(b, slice(None), *at, v, u)].numpy(), ray, drawn.rotation)
                np.testing.assert_allclose(found["transient"][(b, slice(None), *at, v, u)], expected, atol=1e-12)
    torch.testing.assert_close(found["steady"], found["transient"][:, :, :, 0])
    torch.testing.assert_close(found["phasor"], torch.complex(found["transient"], 2 * found["transient"]))


def test_mirrors_turn_the_handedness_over_and_half_turns_and_windows_leave_the_frames():
    light, signs = torch.rand(4, 3, 5, *SIZE), torch.tensor([1.0, 1.0, -1.0, -1.0])[:, None, None, None, None]
    for operation, expected in (
        (Flip(p=1.0), light.flip(-1) * signs), (Flip("vertical", 1.0), light.flip(-2) * signs),
        (QuarterTurn(2), light.flip(-1, -2)), (Crop((1, 2), (1, 0)), light[..., 1:, :2]),
    ):  # fmt: skip
        found = Augment(operation, polarized=True)({"transient": light, "steady": light.sum(2)})
        assert torch.equal(found["transient"], expected)
        torch.testing.assert_close(found["steady"], expected.sum(2))


def test_windows_lie_on_the_image():
    """Anywhere, the last place too; a window that ends with the image is on it."""
    generator = torch.Generator().manual_seed(0)
    places = {tuple(Crop((1, 2)).draw(SIZE, generator).matrix[[0, 1], 2]) for _ in range(60)}
    assert places == {(-u, -v) for u in (0, 1) for v in (0, 1)}
    assert Crop((2, 3)).draw(SIZE, None).matrix.tolist() == np.eye(3).tolist()
    for size, offset in (((2, 2), (0, 2)), ((2, 3), (1, 0)), ((3, 1), None), ((1, 4), None)):
        with pytest.raises(ShapeError, match="do not fit into an image"):
            Crop(size, offset).draw(SIZE, None)


def test_draws_of_kornia():
    """Only numbers come of them, and torch's generator stays where another one is given."""
    from kornia.augmentation import RandomAffine, RandomPerspective

    class Learned(RandomAffine):
        def get_transformation_matrix(self, *arguments):
            return super().get_transformation_matrix(*arguments).requires_grad_()

    def draw(augmentation, seed):
        return Affine(augmentation).draw((5, 5), torch.Generator().manual_seed(seed))

    before = torch.get_rng_state()
    drawn = draw(Learned((30.0, 30.0), p=1.0), 3)
    assert torch.equal(torch.get_rng_state(), before)
    side, across = np.cos(np.radians(30)), np.sin(np.radians(30))
    np.testing.assert_allclose(np.abs(drawn.matrix[:2, :2]), [[side, across], [across, side]], atol=1e-6)
    assert Affine(RandomAffine(30.0, p=0.0)).draw((5, 5), None) is None
    drawn = [draw(RandomAffine(30.0, p=1.0), n).matrix.tobytes() for n in (0, 1, 2, 3, 4, 5, 6, 7, 7)]
    assert len(set(drawn)) == 8 and drawn[-1] == drawn[-2]
    with pytest.raises(SceneError, match="RandomPerspective is no affine map"):
        draw(RandomPerspective(0.5, p=1.0), 0)


def test_half_of_a_pixel_is_rounded_up():
    """Also where the inverse of a map is a little less than that."""
    image = torch.arange(1.0, 5.0).reshape(1, 4)
    third = PixelMap([[3.0, 0.0, -1.5], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], (1, 4), (1, 9))
    for found, moved in (
        (PixelMap([[1.0, 0.0, -0.5], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], (1, 4), (1, 3)), [2, 3, 4]),
        (third, [2, 2, 2, 3, 3, 3, 4, 4, 4]),
    ):
        assert found.nearest(image, 0.0).tolist() == [moved]

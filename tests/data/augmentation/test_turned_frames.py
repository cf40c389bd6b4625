"""Stokes components in turned and mirrored frames: the electric field stays where it is."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchtransient.data import Affine, Augment, Crop, Flip, Operation, PixelMap, QuarterTurn
from torchtransient.errors import SceneError, ShapeError

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


def turned(stokes, ray, rotation):
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
                expected = turned(moved["transient"][(b, slice(None), *at, v, u)].numpy(), ray, drawn.rotation)
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


def test_affine_maps_of_kornia():
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

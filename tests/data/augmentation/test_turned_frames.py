"""Stokes components in turned and mirrored frames: the electric field stays where it is."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchtransient.data import Affine, Crop, Flip, PixelMap, QuarterTurn
from torchtransient.data.augment import turned_stokes
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


@pytest.mark.parametrize("drawn", [QuarterTurn(1).draw(SIZE, None), QuarterTurn(3).draw(SIZE, None), LEAN])
@pytest.mark.parametrize("dim", [-4, -5])
def test_the_field_of_each_pixel_stays(drawn, dim):
    """By batch, channel and bin, with a camera for each entry of the batch."""
    light = torch.rand(2, 4, *[3, 2][: -dim - 3], *drawn.new_size, dtype=torch.float64) - 0.4
    found = turned_stokes(light, dim, drawn, CAMERAS)
    cameras = drawn.intrinsics(CAMERAS.double())
    for b in range(2):
        for v, u in np.ndindex(drawn.new_size):
            ray = np.linalg.solve(cameras[b].numpy(), [u, v, 1.0])
            ray /= np.linalg.norm(ray)
            for at in np.ndindex(*light.shape[2:-2]):
                expected = turned(light[(b, slice(None), *at, v, u)].numpy(), ray, np.asarray(drawn.rotation))
                np.testing.assert_allclose(found[(b, slice(None), *at, v, u)], expected, atol=1e-12)
    # Of phasors both parts.
    phasors = torch.complex(light, 2 * light)
    torch.testing.assert_close(turned_stokes(phasors, dim, drawn, CAMERAS), torch.complex(found, 2 * found))


@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
@pytest.mark.parametrize("dim", [-4, -5])
def test_a_mirror_turns_the_handedness_over(direction, dim):
    light = torch.rand(4, *[3, 5][: -dim - 3], *SIZE)
    found = turned_stokes(light, dim, Flip(direction, 1.0).draw(SIZE, None), None)
    assert torch.equal(found, torch.stack([light[0], light[1], -light[2], -light[3]]))


def test_half_turns_and_windows_leave_the_frames():
    light = torch.rand(4, 3, *SIZE)
    for drawn in (QuarterTurn(2).draw(SIZE, None), Crop((1, 2), (1, 0)).draw(SIZE, None)):
        assert torch.equal(turned_stokes(light, -4, drawn, None), light)
    with pytest.raises(SceneError, match="wants intrinsics= of the camera"):
        turned_stokes(light, -4, QuarterTurn(1).draw(SIZE, None), None)


def test_windows_lie_on_the_image():
    """Anywhere, the last place too; a window that ends with the image is on it."""
    generator = torch.Generator().manual_seed(0)
    places = {tuple(Crop((1, 2)).draw(SIZE, generator).matrix[[0, 1], 2]) for _ in range(60)}
    assert places == {(-u, -v) for u in (0, 1) for v in (0, 1)}
    assert Crop((2, 3)).draw(SIZE, None).matrix.tolist() == np.eye(3).tolist()
    for size, offset in (((2, 2), (0, 2)), ((2, 3), (1, 0)), ((3, 1), None), ((1, 4), None)):
        with pytest.raises(ShapeError, match="do not fit into an image"):
            Crop(size, offset).draw(SIZE, None)


def test_affine_maps_of_kornia_with_a_derivative_of_their_own():
    """Only numbers come of them, and torch's generator stays where another one is given."""
    from kornia.augmentation import RandomAffine, RandomPerspective

    class Learned(RandomAffine):
        def get_transformation_matrix(self, *arguments):
            return super().get_transformation_matrix(*arguments).requires_grad_()

    one = Affine(Learned((30.0, 30.0), p=1.0))
    before = torch.get_rng_state()
    drawn = one.draw((5, 5), torch.Generator().manual_seed(3))
    assert torch.equal(torch.get_rng_state(), before)
    angle = np.radians(30)
    side, across = np.cos(angle), np.sin(angle)
    np.testing.assert_allclose(np.abs(drawn.matrix[:2, :2]), [[side, across], [across, side]], atol=1e-6)
    assert Affine(RandomAffine(30.0, p=0.0)).draw((5, 5), None) is None
    first, again = (Affine(RandomAffine(30.0, p=1.0)).draw((5, 5), torch.Generator().manual_seed(n)) for n in (4, 4))
    assert np.array_equal(first.matrix, again.matrix)
    eight = [Affine(RandomAffine(30.0, p=1.0)).draw((5, 5), torch.Generator().manual_seed(n)) for n in range(8)]
    assert len({drawn.matrix.tobytes() for drawn in eight}) == 8
    with pytest.raises(SceneError, match="RandomPerspective is no affine map"):
        Affine(RandomPerspective(0.5, p=1.0)).draw((5, 5), torch.Generator().manual_seed(0))


def test_half_of_a_pixel_is_rounded_up():
    """Also where the inverse of a map is a little less than that."""
    image = torch.arange(1.0, 5.0).reshape(1, 4)
    third = PixelMap([[3.0, 0.0, -1.5], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], (1, 4), (1, 9))
    for found, moved in (
        (PixelMap([[1.0, 0.0, -0.5], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], (1, 4), (1, 3)), [2, 3, 4]),
        (third, [2, 2, 2, 3, 3, 3, 4, 4, 4]),
    ):
        assert found.nearest(image, 0.0).tolist() == [moved]

"""Images of every type: nothing is cut off, wrapped around or left where it was without a word."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import kornia
import numpy as np
import pytest
import torch
from kornia.augmentation import RandomAffine
from PIL import Image

from support.sweeps import together
from torchtransient.data import (
    Affine,
    Augment,
    Crop,
    Flip,
    Operation,
    PixelMap,
    QuarterTurn,
    SpatialFilter,
    spatial_filter,
)
from torchtransient.errors import SceneError, ShapeError, UnitError

H, W = 4, 6
FLOATING = (torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.complex64)
SIGNED = (torch.int8, torch.int16, torch.int32, torch.int64)
UNSIGNED = (torch.uint8, torch.uint16, torch.uint32, torch.uint64)
TYPES = (torch.bool, *FLOATING, *SIGNED, *UNSIGNED)
# Half the image to the right and down: pixels come to lie on pixels, and there is a rim.
SHIFT = np.array([[1.0, 0, 3], [0, 1, 2], [0, 0, 1]])
TURN = Affine(RandomAffine((10.0, 10.0), p=1.0))
# What stands beyond the rim; None for a type that cannot hold it.
BEYOND = {
    "number": {torch.bool: 0, **dict.fromkeys((*FLOATING, *SIGNED), -1)},
    "label": {torch.bool: 0, **dict.fromkeys(FLOATING, torch.nan)},
    "light": dict.fromkeys(TYPES, 0),
}


@dataclass
class Given(Operation):
    """The same map in every call."""

    matrix: Any
    new_size: Any = (H, W)
    seen: Any = None

    def draw(self, size, generator):
        return PixelMap(self.matrix, self.seen or size, self.new_size)


def ramp(dtype):
    return (torch.arange(1, H * W + 1).reshape(H, W) % 2 if dtype == torch.bool else
            torch.arange(1, H * W + 1).reshape(H, W)).to(dtype)  # fmt: skip


@together("dtype", TYPES)
@together("kind", BEYOND)
def test_every_type_of_every_kind(kind, dtype):
    image = ramp(dtype)
    plain = image.to(torch.complex128 if dtype.is_complex else torch.float64)
    fields = {"it": kind}
    for operation, expected in (
        (Flip(p=1.0), plain.flip(-1)), (QuarterTurn(1), torch.rot90(plain, 1, (-2, -1))),
        (Crop((2, 3), (1, 2)), plain[1:3, 2:5]),
    ):  # fmt: skip
        found = Augment(operation, fields=fields)({"it": image})["it"]
        assert found.dtype == dtype and torch.equal(found.to(plain.dtype), expected)
    beyond = BEYOND[kind].get(dtype)
    augment = Augment(Given(SHIFT), fields=fields)
    if beyond is None:
        with pytest.raises(UnitError, match=f"'it' of {dtype} cannot hold"):
            augment({"it": image})
    else:
        expected = torch.full_like(plain, beyond)
        expected[2:, 3:] = plain[:2, :3]
        found = augment({"it": image})["it"]
        assert found.dtype == dtype
        assert torch.allclose(found.to(plain.dtype), expected, rtol=0, atol=0, equal_nan=True)
    refused = beyond is None or (kind == "light" and dtype not in FLOATING)
    if refused:
        with pytest.raises(UnitError, match=r"cannot (hold|be interpolated).*convert it with \.(float|long)"):
            Augment(TURN, fields=fields)({"it": image})
    else:
        found = Augment(TURN, fields=fields)({"it": image})["it"]
        assert found.dtype == dtype and found.shape == image.shape


def test_a_rim_that_this_draw_does_not_have():
    """Whether a type can be augmented does not depend on what is drawn: a map of kornia's may have a rim."""
    larger = Augment(Affine(RandomAffine(0.0, scale=(2.0, 2.0), p=1.0)))
    assert bool(larger({"depth": torch.ones(H, W)})["depth"].isfinite().all())
    with pytest.raises(UnitError, match=r"cannot hold nan.*\.float\(\), or call it a number"):
        larger({"depth": torch.ones(H, W, dtype=torch.int64)})


def test_counts_have_zero_beyond_the_rim():
    for dtype in TYPES:
        found = Augment(Given(SHIFT))({"measurement": ramp(dtype)})["measurement"]
        assert found.dtype == dtype and not found[:2].any() and bool(found[2:, 3].all())
    # Told to be something else, it is that.
    found = Augment(Given(SHIFT), fields={"measurement": "number"})({"measurement": ramp(torch.int32)})["measurement"]
    assert found[0, 0] == -1


def test_points_directions_and_stokes_components_are_floating():
    for name in ("position", "normals"):
        with pytest.raises(UnitError, match=f"{name}' as a floating dtype"):
            Augment(Flip(p=1.0))({name: torch.ones(3, H, W).int(), "to_world": torch.eye(4)})
    whole = {"steady": torch.ones(4, 1, H, W, dtype=torch.uint8), "intrinsics": torch.eye(3)}
    for operation in (Flip(p=1.0), QuarterTurn(1)):
        with pytest.raises(UnitError, match="Stokes components of 'steady' as a floating dtype"):
            Augment(operation, polarized=True)(whole)
    assert Augment(Crop((2, 2)), polarized=True)(whole)["steady"].dtype == torch.uint8


# --------------------------------------------------------------------------------------------- what is called an image


@pytest.mark.parametrize("p", [0.0, 1.0])
def test_arrays_are_taken_as_tensors(p):
    mask = np.arange(6).reshape(2, 3)
    given = {"depth": torch.ones(2, 3), "mask": mask, "uv": np.ones((2, 2, 3), ">f4")}
    found = Augment(Flip(p=p), fields={"mask": "number"})(given)
    expected = mask[:, ::-1] if p else mask
    assert isinstance(found["mask"], torch.Tensor) and np.array_equal(found["mask"].numpy(), expected)
    assert found["uv"].dtype == torch.float32
    found["mask"].zero_()
    assert mask.sum() == 15


UNKNOWN = {
    "array": np.zeros((H, W)), "tensor": torch.zeros(2, H, W), "channels last": np.zeros((H, W, 3)),
    "dictionary": {"masks": {"left": torch.zeros(H, W)}}, "list of tensors": [torch.zeros(H, W)],
}  # fmt: skip


@together("name", UNKNOWN)
def test_what_may_be_an_image_is_not_passed_over(name):
    given = {"depth": torch.ones(H, W), "mask": UNKNOWN[name]}
    with pytest.raises(SceneError, match="'mask' has the size of an image"):
        Augment(Flip(p=1.0))(given)
    assert Augment(Flip(p=1.0), fields={"mask": "unchanged"})(given)["mask"] is UNKNOWN[name]


def test_what_is_no_image_is_passed_on():
    given = {"index": 3, "name": "room", "tags": ["a", "b"], "points": np.zeros((9, 3)), "ragged": [[1], [2, 3]],
             "nothing": None, "values": {}}  # fmt: skip
    found = Augment(Flip(p=1.0))({"depth": torch.ones(H, W), **given})
    assert all(found[name] is value for name, value in given.items())


@pytest.mark.parametrize("p", [0.0, 1.0])
def test_samples_share_nothing_with_what_augment_was_given(p):
    matrix, pose = torch.eye(3), torch.eye(4)
    augment = Augment(Flip(p=p), intrinsics=matrix, to_world=pose)
    known = augment({"depth": torch.ones(H, W)})
    first = augment({"depth": torch.ones(H, W), "to_world": None})
    assert all(torch.equal(first[name], known[name]) for name in ("intrinsics", "to_world"))
    kept = {name: one.clone() for name, one in known.items()}
    first["to_world"][0, 3], first["intrinsics"][0, 0] = 9.0, 9.0
    pose[1, 3], matrix[1, 1] = 9.0, 9.0
    for sample in (known, augment({"depth": torch.ones(H, W)})):
        assert all(torch.equal(sample[name], one) for name, one in kept.items())
    given = {"depth": ramp(torch.float32), "steady": ramp(torch.float32)[None], "intrinsics": torch.eye(3)}
    before = {name: one.clone() for name, one in given.items()}
    for operation in (Flip(p=1.0), Given(np.eye(3)), TURN):
        for one in Augment(operation)(given).values():
            one.zero_()
        assert all(torch.equal(given[name], one) for name, one in before.items())


DEPTH = {"depth": torch.ones(H, W)}


@together(
    "call, error, message",
    [
        (lambda: Augment(Flip())({**DEPTH, "mask": Image.new("L", (W, H))}), SceneError, "size of an image"),
        (lambda: Augment(Given(SHIFT, seen=(2, 2)))(DEPTH), ShapeError, r"2, 2\), got \(4, 6\)"),
        (lambda: PixelMap([[1, 0, 0], [0, 1, 0], [0.1, 0, 1]], (2, 2), (2, 2)), ShapeError, "affine matrix"),
        (lambda: PixelMap(np.diag([0.0, 1, 1]), (2, 2), (2, 2)), UnitError, "with an inverse"),
        (lambda: PixelMap(np.diag([np.nan, 1, 1]), (2, 2), (2, 2)), UnitError, "with an inverse"),
        (lambda: PixelMap(np.eye(3), (2, 2), (2, 0)), ShapeError, "at least 1"),
    ],
)  # fmt: skip
def test_what_it_refuses(call, error, message):
    with pytest.raises(error, match=message):
        call()


def test_a_map_that_enlarges():
    found = Augment(Given(np.diag([2.0, 2.0, 1.0]), (2 * H, 2 * W)))({"depth": ramp(torch.float32)})["depth"]
    assert found.shape == (2 * H, 2 * W) and torch.equal(found[::2, ::2], ramp(torch.float32))


# -------------------------------------------------------------------------------------------------------------- filters


FILTERS = {
    "gaussian": lambda x: kornia.filters.gaussian_blur2d(x, (3, 3), (1.0, 1.0)),
    "median": lambda x: kornia.filters.median_blur(x, (3, 3)),
    "bilateral": lambda x: kornia.filters.bilateral_blur(x, (3, 3), 0.2, (1.0, 1.0)),
    "half the size": kornia.geometry.transform.PyrDown(),
}


@pytest.mark.parametrize("name", FILTERS)
def test_each_bin_is_an_image_of_its_own(name, monkeypatch):
    light = torch.rand(2, 3, 7, 8, 6, generator=torch.Generator().manual_seed(1))
    monkeypatch.setattr("torchtransient.data.spatial_filters._AT_ONCE", 10)
    found = spatial_filter(FILTERS[name], light)
    for k in ((0, 0, 0), (1, 2, 6), (1, 0, 3)):
        assert torch.allclose(found[k], FILTERS[name](light[k][None, None])[0, 0], atol=1e-6)
    assert torch.allclose(SpatialFilter(FILTERS[name])(light), found, atol=1e-6)
    # A bin alone: what is in the others has no part in it.
    alone = torch.zeros_like(light)
    alone[:, :, 3] = light[:, :, 3]
    assert torch.allclose(spatial_filter(FILTERS[name], alone)[:, :, 3], found[:, :, 3], atol=1e-6)
    assert not spatial_filter(FILTERS[name], alone)[:, :, 4].any()


def test_gradients_and_empty():
    light = torch.rand(1, 3, 4, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(2)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: spatial_filter(FILTERS["gaussian"], x), (light,))
    assert spatial_filter(FILTERS["gaussian"], torch.zeros(0, 3, 4, 4)).shape == (0, 3, 4, 4)


def test_what_a_filter_refuses():
    with pytest.raises(UnitError, match="floating dtype"):
        spatial_filter(FILTERS["median"], torch.ones(3, 4, 4, dtype=torch.complex64))
    with pytest.raises(ShapeError, match=r"images \(..., H, W\), got \(4,\)"):
        spatial_filter(FILTERS["median"], torch.ones(4))
    with pytest.raises(ShapeError, match=r"to make images \(3, 1, 4, 4\), got \(1, 4, 4\)"):
        spatial_filter(lambda x: x[0], torch.ones(3, 4, 4))

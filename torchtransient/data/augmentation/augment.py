"""``tt.data.Augment``: one map of the pixels for all that a sample has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from torchtransient.checks import flag, shown
from torchtransient.data.augmentation.operations import Operation
from torchtransient.data.augmentation.pixel_map import PixelMap
from torchtransient.data.augmentation.sample_images import as_image, check_unknown, size_of
from torchtransient.data.augmentation.scene_values import check_values
from torchtransient.data.augmentation.stokes_fields import turned_stokes
from torchtransient.errors import ArgumentError, SceneError, ShapeError, UnitError
from torchtransient.geometry.pinhole import camera_matrices, transforms

Kind = Literal["light", "label", "number", "point", "direction", "unchanged"]
# Light with rows of histograms before time.
_ROWS = ("rates", "beats")
KINDS: dict[str, Kind] = {
    **dict.fromkeys(("transient", "steady", "phasor", "gated", *_ROWS), "light"),
    # Counts are no light that could be interpolated: neighbours' noise would no longer be that of a detector.
    "measurement": "label",
    **dict.fromkeys(("depth", "z_depth", "uv", "albedo", "first_return", "radial_velocity"), "label"),
    **dict.fromkeys(("shape", "primitive", "material"), "number"),
    "position": "point",
    **dict.fromkeys(("normals", "velocity"), "direction"),
}
# What a sample has besides images, by names that `fields` cannot give another meaning.
_NAMED = ("intrinsics", "to_world", "values", "outside")


class Augment:
    """Draws one map of the pixels and applies it to all of a sample: light, labels, and the camera.

    ``operations``: of :class:`Flip`, :class:`QuarterTurn`, :class:`Crop`, :class:`Affine`, one after another. A call
    takes a dictionary as :class:`~torchtransient.data.TransientDataset` has them, or a tuple whose entries ``names``
    are; leading dimensions of a batch get the same map. It returns a new one; what is given stays as it is, and what no
    map changes is passed on, not copied. Arrays of numpy that are images come back as tensors.

    - ``transient``, ``steady``, ``phasor``, ``gated``, ``rates``, ``beats``: interpolated between pixels, bin by bin,
      where pixels do not come to lie on pixels; zero beyond the rim. They are radiance: larger pixels are not brighter.
      UnitError for whole numbers that would have to be interpolated.
    - ``depth``, ``z_depth``, ``uv``, ``albedo``, ``first_return``, ``radial_velocity``: the nearest pixel, since
      between two depths there is no surface; NaN beyond the rim. Distances stay what they are: the camera is turned
      about its axis, mirrored, or has another matrix. ``measurement``: the nearest pixel; 0 beyond the rim.
    - ``shape``, ``primitive``, ``material``: the nearest pixel; -1 beyond the rim.
    - Beyond the rim truth values are False. UnitError for a type that cannot hold what stands there (NaN: whole
      numbers; -1: unsigned ones), of maps that may have a rim: kornia's. Flips, turns and crops take every type.
    - ``position``, ``normals``, ``velocity``: the nearest pixel. Of a mirrored image the world is mirrored in the
      camera's frame, for which ``to_world`` of the camera is needed.
    - ``intrinsics``, ``to_world``: those of the camera that has taken the new image (:mod:`torchtransient.geometry`).
    - ``values``: stay. SceneError where the map makes one of them false, a place in a mirror or an angle of view in a
      crop, or where a key is not known not to be; read the data set without (``fields=``).
    - Stokes components (``polarized``): S2 and S3 change their signs in a mirror, and all is turned with the sensor's
      frame, which needs ``intrinsics`` but for half turns.

    ``intrinsics``, ``to_world``: of the camera, where samples do not have them; samples get the new ones under these
    names. ``polarized``: light has four Stokes components before the channels. ``fields``: what to do with other names,
    ``{"mask": "number"}``: "light", "label" (nearest, NaN beyond the rim), "number" (nearest, -1), "point" and
    "direction" (3, H, W) of the world, "unchanged"; without, what has the size of an image is a SceneError.

    ``sensor``: what the camera is called in the keys of ``values``, or several; without it every ``to_world`` might be
    the camera's, and is false of a turned one. ``kept_values``: keys of ``values`` that are known to stay true.

    Not supported: exhaustive scans, orthographic cameras where they are turned with Stokes components. Raises
    ShapeError, SceneError, UnitError.
    """

    def __init__(
        self,
        operations: Operation | Sequence[Operation],
        *,
        intrinsics: Any = None,
        to_world: Any = None,
        polarized: bool = False,
        fields: Mapping[str, Kind] | None = None,
        names: Sequence[str] | None = None,
        sensor: str | Sequence[str] = (),
        kept_values: Sequence[str] = (),
    ) -> None:
        given = list(operations) if isinstance(operations, Sequence) else [operations]
        for one in given:
            if not isinstance(one, Operation):
                raise ArgumentError(f"Augment: expected Flip, QuarterTurn, Crop or Affine, got {shown(one)}.")
        self.operations = tuple(given)
        # Copies: what is given may change afterwards.
        self.camera = {
            "intrinsics": None if intrinsics is None else camera_matrices(intrinsics, "Augment").clone(),
            "to_world": None if to_world is None else transforms(to_world, "Augment").clone(),
        }
        self.polarized = flag("Augment: polarized", polarized)
        self.kinds: dict[str, Kind] = {**KINDS, **_checked_fields(fields)}
        self.names = None if names is None else _texts("names", names)
        self.cameras = (sensor,) if isinstance(sensor, str) else _texts("sensor", sensor)
        self.kept_values = _texts("kept_values", kept_values)

    def __call__(self, sample: Any, *, generator: torch.Generator | None = None) -> Any:
        """A new sample, with one map drawn. ``generator``: None for torch's own."""
        if generator is not None and not isinstance(generator, torch.Generator):
            raise ArgumentError(f"Augment: expected generator as a torch.Generator, got {shown(generator)}.")
        if isinstance(sample, Mapping):
            return self._augmented(dict(sample), generator)
        if self.names is None or not isinstance(sample, Sequence) or len(sample) != len(self.names):
            raise ArgumentError(
                f"Augment: expected a dictionary, or with names= a tuple of as many, got {shown(sample)} with "
                f"names={self.names}."
            )
        found = self._augmented(dict(zip(self.names, sample, strict=True)), generator)
        return tuple(found[name] for name in self.names)

    # ------------------------------------------------------------------------------------------------------ one call

    def _augmented(self, sample: dict[str, Any], generator: torch.Generator | None) -> dict[str, Any]:
        for name, default in self.camera.items():
            if default is not None and sample.get(name) is None:
                # A copy, since a sample is its receiver's to change.
                sample[name] = default.clone()
        for name, check in (("intrinsics", camera_matrices), ("to_world", transforms)):
            if sample.get(name) is not None:
                sample[name] = check(sample[name], "Augment")
        names = [name for name in sample if self._kind(name) != "unchanged"]
        sample |= {name: as_image(name, sample[name]) for name in names}
        size = size_of({name: sample[name] for name in names}, tuple(KINDS))
        for name, given in sample.items():
            if name not in self.kinds and name not in _NAMED:
                check_unknown(name, given, size)
        for operation in self.operations:
            drawn = operation.draw(size, generator)
            if drawn is None:
                continue
            if not isinstance(drawn, PixelMap) or drawn.size != size:
                got = f"one of {drawn.size}" if isinstance(drawn, PixelMap) else shown(drawn)
                raise SceneError(
                    f"Augment: expected {type(operation).__name__}.draw to return a PixelMap of images of {size}, or "
                    f"None, got {got}."
                )
            sample = self._mapped(sample, {name: sample[name] for name in names}, drawn)
            size = drawn.new_size
        return sample

    def _kind(self, name: str) -> Kind:
        return self.kinds.get(name, "unchanged")

    def _mapped(self, sample: dict[str, Any], images: Mapping[str, Tensor], drawn: PixelMap) -> dict[str, Any]:
        check_values(sample.get("values"), drawn, self.cameras, self.kept_values)
        found = dict(sample)
        for name, image in images.items():
            kind = self._kind(name)
            if kind == "light":
                moved = drawn.smooth(image, name)
                found[name] = self._stokes(name, moved, drawn, sample) if self.polarized else moved
            elif kind in ("point", "direction"):
                found[name] = _in_the_world(name, kind, image, drawn, sample.get("to_world"))
            else:
                found[name] = drawn.nearest(image, self._fill(name, image), name)
        if self.polarized and "measurement" in images and (drawn.turns or drawn.mirror is not None):
            raise SceneError(
                "Augment: a measurement of polarized light does not tell what the turned or mirrored scene would give; "
                "augment the transient, and measure afterwards."
            )
        if sample.get("intrinsics") is not None:
            found["intrinsics"] = drawn.intrinsics(sample["intrinsics"])
        if sample.get("to_world") is not None:
            found["to_world"] = drawn.to_world(sample["to_world"])
        return found

    def _fill(self, name: str, image: Tensor) -> float:
        if image.dtype == torch.bool or (name == "measurement" and self._kind(name) == "label"):
            return 0
        return -1 if self._kind(name) == "number" else torch.nan

    def _stokes(self, name: str, light: Tensor, drawn: PixelMap, sample: Mapping[str, Any]) -> Tensor:
        dim = {"steady": -4, **dict.fromkeys(_ROWS, -6)}.get(name, -5)
        if light.ndim < -dim or light.shape[dim] != 4:
            raise ShapeError(
                f"Augment: expected the 4 Stokes components of {name!r} in dimension {dim}, got {tuple(light.shape)}."
            )
        moves = drawn.turns or drawn.mirror is not None
        if moves and not light.is_floating_point() and not light.is_complex():
            raise UnitError(
                f"Augment: expected the Stokes components of {name!r} as a floating dtype, got {light.dtype}: they "
                "change their signs, and are turned; convert them with .float()."
            )
        return turned_stokes(light, dim, drawn, sample.get("intrinsics"))


def _checked_fields(fields: Any) -> dict[str, Kind]:
    if fields is None:
        return {}
    if not isinstance(fields, Mapping):
        raise ArgumentError(f'Augment: expected fields as a dictionary, {{"mask": "number"}}, got {shown(fields)}.')
    for name, kind in fields.items():
        if kind not in get_args(Kind):
            raise ArgumentError(f"Augment: expected fields among {', '.join(get_args(Kind))}, got {shown(kind)}.")
        if name in _NAMED:
            raise ArgumentError(
                f"Augment: {name!r} is no image: expected other names than {', '.join(_NAMED)} in fields."
            )
    return dict(fields)


def _texts(what: str, given: Any) -> tuple[str, ...]:
    if isinstance(given, str) or not isinstance(given, Sequence) or not all(isinstance(one, str) for one in given):
        raise ArgumentError(f"Augment: expected {what} as a sequence of names, got {shown(given)}.")
    return tuple(given)


def _in_the_world(name: str, kind: Kind, image: Tensor, drawn: PixelMap, to_world: Tensor | None) -> Tensor:
    if image.ndim < 3 or image.shape[-3] != 3:
        raise ShapeError(f"Augment: expected {name!r} as (..., 3, H, W), got {tuple(image.shape)}.")
    if not image.is_floating_point():
        raise UnitError(
            f"Augment: expected {name!r} as a floating dtype, got {image.dtype}; convert it with .float(), or call it "
            "a label in fields=."
        )
    image = drawn.nearest(image, torch.nan, name)
    if drawn.mirror is None:
        return image
    if to_world is None:
        raise SceneError(
            f"Augment: {name!r} is of the world, which a flip mirrors in the camera's plane: give to_world= of the "
            "sensor, or leave it out."
        )
    mirror = drawn.mirrored_world(to_world).to(image.device, image.dtype)
    moved = torch.matmul(mirror[..., :3, :3], image.flatten(-2)).reshape(image.shape)
    return moved if kind == "direction" else moved + mirror[..., :3, 3, None, None]

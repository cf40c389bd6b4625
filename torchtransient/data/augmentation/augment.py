"""``tt.data.Augment``: one map of the pixels for all that a sample has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from torchtransient.data.augmentation.operations import Operation
from torchtransient.data.augmentation.pixel_map import PixelMap
from torchtransient.data.augmentation.stokes_fields import turned_stokes
from torchtransient.errors import SceneError, ShapeError
from torchtransient.geometry.pinhole import camera_matrices, transforms
from torchtransient.quantities import shown

Kind = Literal["light", "label", "number", "point", "direction", "unchanged"]
KINDS: dict[str, Kind] = {
    **dict.fromkeys(("transient", "steady", "phasor", "gated"), "light"),
    # Counts are no light that could be interpolated: neighbours' noise would no longer be that of a detector.
    "measurement": "label",
    **dict.fromkeys(("depth", "z_depth", "uv", "albedo", "first_return"), "label"),
    **dict.fromkeys(("shape", "primitive", "material"), "number"),
    "position": "point",
    "normals": "direction",
}
# Entries of `values` that a mirror of the world makes false, by the last part of the key, and those that a camera has.
_PLACES = frozenset(
    ("to_world", "position", "positions", "direction", "origin", "target", "center", "p0", "p1", "vertex_positions",
     "vertex_normals", "control_points", "laser_positions", "laser_position")
)  # fmt: skip
_OPTICS = ("x_fov", "fov", "principal_point_offset_x", "principal_point_offset_y")
_NAMED = ("intrinsics", "to_world")


class Augment:
    """Draws one map of the pixels and applies it to all of a sample: light, labels, and the camera.

    ``operations``: of :class:`Flip`, :class:`QuarterTurn`, :class:`Crop`, :class:`Affine`, one after another. A call
    takes a dictionary as :class:`~torchtransient.data.TransientDataset` has them, or a tuple whose entries ``names``
    are; leading dimensions of a batch get the same map. It returns a new one; what is given stays as it is.

    - ``transient``, ``steady``, ``phasor``, ``gated``: interpolated between pixels, bin by bin, where pixels do not
      come to lie on pixels; zero beyond the rim. They are radiance: larger pixels are not brighter.
    - ``depth``, ``z_depth``, ``uv``, ``albedo``, ``first_return``: the nearest pixel, since between two depths there is
      no surface; NaN beyond the rim. Distances stay what they are: the camera is turned about its axis, mirrored, or
      has another matrix. ``measurement``: the nearest pixel; 0 beyond the rim.
    - ``shape``, ``primitive``, ``material``: the nearest pixel; -1 beyond the rim.
    - ``position``, ``normals``: the nearest pixel. Of a mirrored image the world is mirrored in the camera's frame, for
      which ``to_world`` of the camera is needed.
    - ``intrinsics``, ``to_world``: those of the camera that has taken the new image (:mod:`torchtransient.geometry`).
    - ``values``: stay. SceneError where the map makes one of them false; read the data set without (``fields=``).
    - Stokes components (``polarized``): S2 and S3 change their signs in a mirror, and all is turned with the sensor's
      frame, which needs ``intrinsics`` but for half turns.

    ``intrinsics``, ``to_world``: of the camera, where samples do not have them; samples get the new ones under these
    names. ``polarized``: light has four Stokes components before the channels. ``fields``: what to do with other names,
    ``{"mask": "number"}``: "light", "label" (nearest, NaN beyond the rim), "number" (nearest, -1), "point" and
    "direction" (3, H, W) of the world, "unchanged". ``sensor``: what the camera is called in the keys of ``values``.

    Not supported: exhaustive scans, orthographic cameras where they are turned with Stokes components. Raises
    ShapeError, SceneError.
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
        sensor: str = "sensor",
    ) -> None:
        given = [operations] if isinstance(operations, Operation) else list(operations)
        for one in given:
            if not isinstance(one, Operation):
                raise SceneError(f"Augment: expected Flip, QuarterTurn, Crop or Affine, got {shown(one)}.")
        self.operations = tuple(given)
        self.camera = {
            "intrinsics": None if intrinsics is None else camera_matrices(intrinsics, "Augment"),
            "to_world": None if to_world is None else transforms(to_world, "Augment"),
        }
        self.polarized, self.sensor = bool(polarized), sensor
        wrong = [kind for kind in (fields or {}).values() if kind not in get_args(Kind)]
        if wrong:
            raise SceneError(f"Augment: expected fields among {', '.join(get_args(Kind))}, got {shown(wrong[0])}.")
        self.kinds: dict[str, Kind] = {**KINDS, **(fields or {})}
        self.names = None if names is None else tuple(names)

    def __call__(self, sample: Any, *, generator: torch.Generator | None = None) -> Any:
        """A new sample, with one map drawn. ``generator``: None for torch's own."""
        if isinstance(sample, Mapping):
            return self._augmented(dict(sample), generator)
        if self.names is None or not isinstance(sample, Sequence) or len(sample) != len(self.names):
            raise SceneError(
                f"Augment: expected a dictionary, or with names= a tuple of as many, got {shown(sample)} with "
                f"names={self.names}."
            )
        found = self._augmented(dict(zip(self.names, sample, strict=True)), generator)
        return tuple(found[name] for name in self.names)

    # ------------------------------------------------------------------------------------------------------ one call

    def _augmented(self, sample: dict[str, Any], generator: torch.Generator | None) -> dict[str, Any]:
        known = dict(sample)
        for name, default in self.camera.items():
            if default is not None:
                sample.setdefault(name, default)
        for name, check in (("intrinsics", camera_matrices), ("to_world", transforms)):
            if sample.get(name) is not None:
                sample[name] = check(sample[name], "Augment")
        for operation in self.operations:
            images = {name: one for name, one in sample.items() if self._kind(name) != "unchanged"}
            size = _image_size(images)
            self._check_unknown(sample, size)
            drawn = operation.draw(size, generator)
            if drawn is not None:
                sample = self._mapped(sample, images, drawn)
        return {name: value for name, value in sample.items() if name in known or value is not None}

    def _kind(self, name: str) -> Kind:
        return self.kinds.get(name, "unchanged")

    def _check_unknown(self, sample: Mapping[str, Any], size: tuple[int, int]) -> None:
        for name, value in sample.items():
            told = name in self.kinds or name in _NAMED
            if isinstance(value, Tensor) and not told and tuple(value.shape[-2:]) == size:
                raise SceneError(
                    f"Augment: {name!r} has the size of an image and nothing says what it is; give "
                    f'fields={{"{name}": "label"}}, "number", "light", "point", "direction" or "unchanged".'
                )

    def _mapped(self, sample: dict[str, Any], images: Mapping[str, Tensor], drawn: PixelMap) -> dict[str, Any]:
        self._check_values(sample.get("values"), drawn)
        found = dict(sample)
        for name, image in images.items():
            kind = self._kind(name)
            if kind == "light":
                moved = drawn.smooth(image)
                found[name] = self._stokes(name, moved, drawn, sample) if self.polarized else moved
            elif kind in ("point", "direction"):
                found[name] = _in_the_world(name, kind, drawn.nearest(image, torch.nan), drawn, sample.get("to_world"))
            else:
                found[name] = drawn.nearest(image, self._fill(name, image))
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
        if name == "measurement" or image.dtype == torch.bool:
            return 0
        if self._kind(name) == "number" or not image.is_floating_point():
            return -1
        return torch.nan

    def _stokes(self, name: str, light: Tensor, drawn: PixelMap, sample: Mapping[str, Any]) -> Tensor:
        dim = -4 if name == "steady" else -5
        if light.ndim < -dim or light.shape[dim] != 4:
            raise ShapeError(
                f"Augment: expected the 4 Stokes components of {name!r} in dimension {dim}, got {tuple(light.shape)}."
            )
        return turned_stokes(light, dim, drawn, sample.get("intrinsics"))

    def _check_values(self, values: Any, drawn: PixelMap) -> None:
        for key in values if isinstance(values, Mapping) else ():
            parts = key.split(".")
            of_camera = parts[0] == self.sensor
            moved = parts[-1] in _PLACES and (drawn.mirror is not None or (drawn.turns and of_camera))
            if moved or (of_camera and parts[-1] in _OPTICS and drawn.changes_intrinsics):
                raise SceneError(
                    f"Augment: the value {key!r} is not true of the augmented sample. Read the data set without "
                    "values, TransientDataset(..., fields=[...]), or use operations that keep it."
                )


def _image_size(images: Mapping[str, Any]) -> tuple[int, int]:
    sizes = {}
    for name, image in images.items():
        if not isinstance(image, Tensor) or image.ndim < 2:
            got = tuple(image.shape) if isinstance(image, Tensor) else type(image).__name__
            raise ShapeError(f"Augment: expected {name!r} as an image (..., H, W), got {got}.")
        sizes[name] = (int(image.shape[-2]), int(image.shape[-1]))
    if not sizes:
        raise SceneError(f"Augment: expected images among {', '.join(KINDS)}, got none; name others in fields=.")
    if len(set(sizes.values())) > 1:
        raise ShapeError(f"Augment: expected images of one size, got {sizes}. Leave out those of other sizes.")
    return next(iter(sizes.values()))


def _in_the_world(name: str, kind: Kind, image: Tensor, drawn: PixelMap, to_world: Tensor | None) -> Tensor:
    if image.ndim < 3 or image.shape[-3] != 3:
        raise ShapeError(f"Augment: expected {name!r} as (..., 3, H, W), got {tuple(image.shape)}.")
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

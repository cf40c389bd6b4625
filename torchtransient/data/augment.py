"""Augmentation of samples: one map of the pixels for light, labels and camera, drawn for each sample of a data set."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset, IterableDataset

from torchtransient import geometry
from torchtransient.array_files.array_file import tensor_in
from torchtransient.checks import count, shown
from torchtransient.data.augmented_values import check_values
from torchtransient.data.operations import Operation, PixelMap
from torchtransient.data.sample import Epochs, checked_seed, sample_generator, sample_number
from torchtransient.data.transient_dataset import TransientStream
from torchtransient.errors import ArgumentError, SceneError, ShapeError, UnitError
from torchtransient.geometry.pinhole import camera_matrices, transforms
from torchtransient.stokes import rotate_frame

# The sensor's horizontal axis is cross(ray, up), and up in kornia's camera is -y (docs/polarization.md).
_UP = (0.0, -1.0, 0.0)
Kind = Literal["light", "label", "number", "point", "direction", "unchanged"]
# Light with an axis of rows before time.
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
# Entries besides images.
_NAMED = ("intrinsics", "to_world", "values", "outside")


class Augment:
    """Draw one map of the pixels and apply it to all of a sample: light, labels, and the camera.

    A call takes a dictionary like the samples of :class:`~torchtransient.data.TransientDataset`, or a tuple whose
    entries ``names`` lists; leading dimensions of a batch get the same map. It returns a new sample; entries that no
    map changes are passed on, not copied. Images of numpy come back as tensors.

    - ``transient``, ``steady``, ``phasor``, ``gated``, ``rates``, ``beats``: interpolated between pixels, bin by bin,
      where pixels do not come to lie on pixels; zero beyond the rim. They are radiance: larger pixels are not brighter.
    - ``depth``, ``z_depth``, ``uv``, ``albedo``, ``first_return``, ``radial_velocity``: the nearest pixel, since
      between two depths there is no surface; NaN beyond the rim. Distances stay as they are: the camera is turned
      about its axis, mirrored, or has another matrix. ``measurement``: the nearest pixel; 0 beyond the rim.
    - ``shape``, ``primitive``, ``material``: the nearest pixel; -1 beyond the rim. Truth values: False beyond the rim.
    - ``position``, ``normals``, ``velocity``: the nearest pixel. Of a mirrored image the world is mirrored in the
      camera's frame, for which ``to_world`` of the camera is needed.
    - ``intrinsics``, ``to_world``: of the camera that has taken the new image (:mod:`torchtransient.geometry`).
    - ``values``: stay; an error where the map makes one of them false (a place in a mirror, a field of view in a crop),
      or where a key is not known to stay true. Read the data set without them (``fields=``).
    - Stokes components (``polarized``): S2 and S3 change their signs in a mirror, and all are turned with the sensor's
      frame, which needs ``intrinsics`` except for half turns.

    Args:
        operations: :class:`Flip`, :class:`QuarterTurn`, :class:`Crop`, :class:`Affine`, one or several in a row.
        intrinsics: intrinsic matrix (..., 3, 3) of the camera, for samples without an entry of this name; results have
            the new one.
        to_world: pose (..., 4, 4) of the camera, likewise for samples without an entry of this name.
        polarized: light has four Stokes components before the channels.
        fields: treatment of entries of other names, ``{"mask": "number"}``: "light", "label" (nearest, NaN beyond the
            rim), "number" (nearest, -1), "point" and "direction" (3, H, W) of the world, "unchanged".
        names: names of the entries, for samples that are tuples.
        sensor: name of the camera in the keys of ``values``, or several; without it every ``to_world`` might be the
            camera's.
        kept_values: keys of ``values`` that are known to stay true.

    Raises:
        ShapeError: for images of several sizes and wrong components.
        SceneError: for entries of an image's size without a treatment, and values that become false.
        UnitError: for types that can neither be interpolated nor hold the value beyond the rim. Flips, turns and crops
            take every type.
        ArgumentError: for other arguments.

    Not supported: exhaustive scans, orthographic cameras where they are turned with Stokes components.
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
        self.operations = tuple(operations) if isinstance(operations, Sequence) else (operations,)
        # Copies: the caller may change its tensors afterwards.
        self.camera = {
            "intrinsics": None if intrinsics is None else camera_matrices(intrinsics, "Augment").clone(),
            "to_world": None if to_world is None else transforms(to_world, "Augment").clone(),
        }
        self.polarized = polarized
        self.kinds: dict[str, Kind] = {**KINDS, **(fields or {})}
        unknown = [kind for kind in self.kinds.values() if kind not in get_args(Kind)]
        if unknown:
            raise ArgumentError(f"Augment: expected fields among {', '.join(get_args(Kind))}, got {shown(unknown[0])}.")
        self.names = None if names is None else tuple(names)
        self.cameras = (sensor,) if isinstance(sensor, str) else tuple(sensor)
        self.kept_values = tuple(kept_values)

    def __call__(self, sample: Any, *, generator: torch.Generator | None = None) -> Any:
        """Return a new sample with one map drawn.

        Args:
            sample: dictionary, or a tuple of the entries ``names``.
            generator: random generator; None takes torch's own.

        Returns:
            Sample of the same kind.
        """
        if isinstance(sample, Mapping):
            return self._augmented(dict(sample), generator)
        if self.names is None:
            raise ArgumentError(
                f"Augment: expected a dictionary, or names= for the entries of a tuple, got {shown(sample)}."
            )
        found = self._augmented(dict(zip(self.names, sample, strict=True)), generator)
        return tuple(found[name] for name in self.names)

    # ------------------------------------------------------------------------------------------------------ one call

    def _augmented(self, sample: dict[str, Any], generator: torch.Generator | None) -> dict[str, Any]:
        for name, default in self.camera.items():
            if default is not None and sample.get(name) is None:
                # A copy, since the caller may change the sample.
                sample[name] = default.clone()
        for name, check in (("intrinsics", camera_matrices), ("to_world", transforms)):
            if sample.get(name) is not None:
                sample[name] = check(sample[name], "Augment")
        names = [name for name in sample if self.kinds.get(name, "unchanged") != "unchanged"]
        sample |= {name: _image(name, sample[name]) for name in names}
        size = _size_of({name: sample[name] for name in names})
        for name, given in sample.items():
            if name not in self.kinds and name not in _NAMED:
                _check_unknown(name, given, size)
        for operation in self.operations:
            drawn = operation.draw(size, generator)
            if drawn is not None:
                sample = self._mapped(sample, {name: sample[name] for name in names}, drawn)
                size = drawn.new_size
        return sample

    def _mapped(self, sample: dict[str, Any], images: Mapping[str, Tensor], drawn: PixelMap) -> dict[str, Any]:
        check_values(sample.get("values"), drawn, self.cameras, self.kept_values)
        found = dict(sample)
        for name, image in images.items():
            kind = self.kinds[name]
            if kind == "light":
                moved = drawn.smooth(image, name)
                found[name] = self._stokes(name, moved, drawn, sample) if self.polarized else moved
            elif kind in ("point", "direction"):
                found[name] = _in_the_world(name, kind, image, drawn, sample.get("to_world"))
            else:
                found[name] = drawn.nearest(image, _fill(name, kind, image), name)
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


class Augmented(Epochs, Dataset[Any]):
    """Map-style data set with an :class:`Augment` of each sample; for streams see :class:`AugmentedStream`.

    Pickles; for workers that were forked or spawned.

    Args:
        dataset: map-style data set, whose samples are read by number.
        augment: augmentation, drawn anew for each sample.
        seed: seed of the maps. Each sample has a generator of its own, so that it is the same in every worker, in every
            epoch until :meth:`set_epoch`; None draws from torch's, anew each time.

    Raises:
        ArgumentError: for streams.
        UnitError: for a seed or an epoch below zero.
        IndexError: beyond the samples.
    """

    def __init__(self, dataset: Any, augment: Augment, seed: int | None = None) -> None:
        super().__init__()
        if isinstance(dataset, IterableDataset):
            raise ArgumentError(f"Augmented: {shown(dataset)} is a stream; use AugmentedStream.")
        self.dataset, self.augment, self.seed = dataset, augment, checked_seed("Augmented", seed)

    def __len__(self) -> int:
        return len(self.dataset)

    def sample(self, number: int, epoch: int | None = None) -> Any:
        """Return a sample.

        Args:
            number: number of the sample in the data set, from 0; negative ones count from the end.
            epoch: number of the epoch, which distinguishes the maps of epochs, and the noise of a data set of this
                library with a seed of its own; None is 0.

        Returns:
            Sample with its map drawn.
        """
        place = sample_number("Augmented", number, len(self.dataset))
        generator = sample_generator("Augmented", self.seed, place, epoch)
        found = self.dataset.sample(place, epoch) if isinstance(self.dataset, Epochs) else self.dataset[place]
        return self.augment(found, generator=generator)


class AugmentedStream(IterableDataset[Any]):
    """Stream (``TransientStream``, ``OnlineDataset``) with an :class:`Augment` of each sample.

    Other attributes of the stream (``set_epoch``, ``close``, ``made``) are found here too; a ``with`` block closes it.

    Args:
        dataset: iterable data set.
        augment: augmentation, drawn anew for each sample.
        seed: seed of the maps. A map depends on it, on the sample's ``index``, on the stream's ``epoch`` where it has
            one, and on how often the sample came before, among the samples of a TransientStream or from this iterator.
            None draws from torch's generator.

    Raises:
        ArgumentError: for data sets that are no streams.
        UnitError: for a seed below zero.
        SceneError: for samples without an ``index`` with a seed.
    """

    def __init__(self, dataset: Any, augment: Augment, seed: int | None = None) -> None:
        # Workers of a DataLoader would each yield all samples of another data set.
        if not isinstance(dataset, IterableDataset):
            raise ArgumentError(f"AugmentedStream: expected a stream, got {shown(dataset)}; use Augmented.")
        self.dataset, self.augment, self.seed = dataset, augment, checked_seed("AugmentedStream", seed)

    def __iter__(self) -> Iterator[Any]:
        epoch = int(getattr(self.dataset, "epoch", 0))
        for sample, repeat in self._repeated():
            generator = None
            if self.seed is not None:
                index = count("AugmentedStream: index", sample["index"], 0)
                generator = sample_generator("AugmentedStream", self.seed, index, epoch, repeat)
            yield self.augment(sample, generator=generator)

    def _repeated(self) -> Iterator[tuple[Any, int]]:
        """Samples, each with the number of times that it came before."""
        if isinstance(self.dataset, TransientStream):
            yield from self.dataset.repeated()
            return
        given = Counter[Any]()
        for sample in self.dataset:
            if self.seed is not None and (not isinstance(sample, Mapping) or "index" not in sample):
                raise SceneError("AugmentedStream: expected samples with an 'index' for seed=; leave seed out.")
            index = sample["index"] if self.seed is not None else None
            yield sample, given[index]
            given[index] += 1

    def __enter__(self) -> AugmentedStream:
        return self

    def __exit__(self, *raised: object) -> None:
        """Close the stream, if it can be closed."""
        close = getattr(self.dataset, "close", None)
        if close is not None:
            close()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "dataset":
            raise AttributeError(name)
        return getattr(self.dataset, name)


def _image(name: str, given: Any) -> Tensor:
    """Image (..., H, W) as a tensor; arrays are copied."""
    image: Tensor = tensor_in(given.copy()) if isinstance(given, np.ndarray) else given
    if image.ndim < 2:
        raise ShapeError(f"Augment: expected {name!r} as an image (..., H, W), got {tuple(image.shape)}.")
    return image


def _size_of(images: Mapping[str, Tensor]) -> tuple[int, int]:
    """Height and width that all images share. Raises SceneError, ShapeError."""
    sizes = {name: (int(image.shape[-2]), int(image.shape[-1])) for name, image in images.items()}
    if not sizes:
        raise SceneError(f"Augment: expected images among {', '.join(KINDS)}, got none; name others in fields=.")
    if len(set(sizes.values())) > 1:
        raise ShapeError(f"Augment: expected images of one size, got {sizes}. Leave out those of other sizes.")
    return next(iter(sizes.values()))


def _check_unknown(name: str, given: Any, size: tuple[int, int]) -> None:
    """Refuse an entry that might be an image: tensors, arrays and pictures of Pillow with two neighbouring dimensions
    of the image's size, mappings and lists that hold one.
    """
    shape = np.shape(given) if hasattr(given, "__array_interface__") else tuple(getattr(given, "shape", ()))
    if any(shape[k : k + 2] == size for k in range(len(shape) - 1)):
        raise SceneError(
            f"Augment: {name!r} has the size of an image, {shape}, and nothing says what it is; give "
            f'fields={{"{name}": "label"}}, "number", "light", "point", "direction" or "unchanged".'
        )
    inside = given.values() if isinstance(given, Mapping) else given if isinstance(given, (list, tuple)) else ()
    for one in inside:
        _check_unknown(name, one, size)


def _fill(name: str, kind: Kind, image: Tensor) -> float:
    """Value beyond the rim."""
    if image.dtype == torch.bool or (name == "measurement" and kind == "label"):
        return 0
    return -1 if kind == "number" else torch.nan


def turned_stokes(light: Tensor, dim: int, drawn: PixelMap, camera_matrix: Tensor | None) -> Tensor:
    """Return the Stokes components in the frames of a camera that has been turned or mirrored.

    A mirror changes the signs of S2 and S3. A turn of the camera turns the frame of each pixel by an angle that depends
    on its ray; half a turn leaves it.

    Args:
        light: Stokes components (..., 4, ..., H, W), already moved.
        dim: dimension of the Stokes components, negative: counted from the last one.
        drawn: map of the pixels.
        camera_matrix: intrinsics (..., 3, 3) of the camera before the map, or None.

    Returns:
        As ``light``.

    Raises:
        SceneError: where the matrix is needed and None.
    """
    if light.is_complex():
        parts = [turned_stokes(part, dim, drawn, camera_matrix) for part in (light.real, light.imag)]
        return torch.complex(parts[0], parts[1])
    if drawn.mirror is not None:
        signs = torch.tensor([1.0, 1.0, -1.0, -1.0], dtype=light.dtype, device=light.device)
        light = light * signs.reshape(4, *[1] * (-dim - 1))
    turn = drawn.rotation
    if np.array_equal(np.abs(turn), np.eye(3)):
        return light
    if camera_matrix is None:
        raise SceneError(
            "Augment: turning Stokes components wants intrinsics= of the camera, since the frame of each pixel depends "
            "on its ray. Flips and half turns do without."
        )
    rays = geometry.ray_directions(drawn.intrinsics(camera_matrix.double()), drawn.new_size)
    rotation = torch.tensor(turn, device=rays.device)
    up = rays.new_tensor(_UP)[:, None, None].expand_as(rays)
    before = _across(rays, torch.einsum("ij,...jhw->...ihw", rotation, up))
    after = _across(rays, up)
    upwards = torch.linalg.cross(before, rays, dim=-3)
    angle = torch.atan2((after * upwards).sum(-3), (after * before).sum(-3)).to(light.dtype)
    # Dimensions behind the components go between those of the camera's matrix and of the image.
    angle = angle.reshape(*angle.shape[:-2], *[1] * (-dim - 3), *angle.shape[-2:])
    return rotate_frame(light, angle, dim)


def _across(rays: Tensor, up: Tensor) -> Tensor:
    """Horizontal axes (..., 3, H, W) of frames."""
    return torch.nn.functional.normalize(torch.linalg.cross(rays, up, dim=-3), dim=-3)


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

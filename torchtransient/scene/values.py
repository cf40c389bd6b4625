"""Values of torch in a built scene: checked, copied into memory of Dr.Jit, written into parameters of Mitsuba."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from torch.autograd import forward_ad

from torchtransient.checks import real_array, shown
from torchtransient.errors import DeviceError, SceneError, ShapeError
from torchtransient.plugins.mitsuba_compat import (
    NORMALS,
    POSITIONS,
    TEXCOORDS,
    check_pose,
    flat_array,
    is_number_of_kernels,
    is_turned_by_reflections,
    key_beside,
    names_array,
)
from torchtransient.scene.build import BuiltScene
from torchtransient.scene.parameters import classify, read_value

# Most entries of a tensor that is copied by way of a list, which is faster than launching a kernel.
FEW = 64


def as_float(key: str, value: Any, device: str) -> torch.Tensor:
    """Return a value as a float32 tensor, by an operation that gradients pass.

    Args:
        key: key of the parameter, for messages.
        value: number, list, array, or tensor; all but tensors are copied to ``device``.
        device: torch device type of the scene's variant.

    Raises:
        ShapeError: for values that are not dense and real.
        DeviceError: for a tensor on another device.
    """
    if value is None:  # which numpy takes for a number that is none
        raise ShapeError(f"value of {key!r}: expected numbers, got None. Leave the key out to keep the current value.")
    if not isinstance(value, torch.Tensor):
        value = _as_tensor(key, value).to(device)
    if value.is_complex() or value.dtype == torch.bool:
        raise ShapeError(f"value of {key!r}: expected real numbers, got dtype {value.dtype}.")
    if value.layout != torch.strided or value.is_nested or value.is_quantized:
        kind = "a nested one" if value.is_nested else f"layout {value.layout} and dtype {value.dtype}"
        raise ShapeError(f"value of {key!r}: expected a dense tensor, got {kind}.")
    if value.device.type != device:
        raise DeviceError(
            f"value of {key!r}: expected a tensor on {device!r}, where the scene's variant computes, got "
            f"{str(value.device)!r}. Move it with .to({device!r}), or load the scene with a variant of the other kind."
        )
    found: torch.Tensor = value.to(torch.float32)
    return found


def _as_tensor(key: str, value: Any) -> torch.Tensor:
    """Return a tensor of a number, of nested lists of numbers and tensors, or of an array of any library."""
    try:
        if _holds_tensors(value):
            return torch.stack([e if isinstance(e, torch.Tensor) else _as_tensor(key, e) for e in value])
    except (TypeError, RuntimeError) as error:  # of different shapes or devices
        raise ShapeError(f"value of {key!r}: expected tensors that can be stacked, got others: {error}.") from error
    array = real_array(value)
    if array is None:
        raise ShapeError(
            f"value of {key!r}: expected a torch tensor, an array, a list of numbers or a number, all of them real, "
            f"got {shown(value)}."
        )
    return torch.from_numpy(array)


def _holds_tensors(value: Any) -> bool:
    """Return whether a nested list holds tensors."""
    listed = isinstance(value, (list, tuple))
    return listed and any(isinstance(entry, torch.Tensor) or _holds_tensors(entry) for entry in value)


def fit_shape(key: str, value: torch.Tensor, shape: tuple[int, ...]) -> tuple[torch.Tensor, bool]:
    """Return a value in the shape of its parameter, and whether it has a leading batch dimension.

    Args:
        key: key of the parameter, for messages.
        value: tensor of ``shape``, (B, *shape), or flat for ``shape`` (N, D).
        shape: shape of the parameter.

    Raises:
        ShapeError: for other shapes.
    """
    got = tuple(value.shape)
    if got == shape:
        return value, False
    if len(got) == len(shape) + 1 and got[1:] == shape:
        return value, True
    flat = math.prod(shape)
    if len(shape) == 2 and got == (flat,):
        return value.reshape(shape), False
    if len(shape) == 2 and len(got) == 2 and got[1] == flat:
        return value.reshape(got[0], *shape), True
    batch = ("B", *shape)
    with_batch = f"({', '.join(str(n) for n in batch)}{',' if len(batch) == 1 else ''})"
    raise ShapeError(f"value of {key!r}: expected shape {shape}, or {with_batch} with a batch, got {got}.")


def may_have_derivative(tensor: torch.Tensor, *, graph: bool = True) -> bool:
    """Return whether autograd, forward mode or a transform of ``torch.func`` may differentiate by a tensor.

    Args:
        tensor: the tensor.
        graph: False under ``torch.no_grad``, where forward mode alone can.
    """
    transforms = torch._C._functorch
    while not ((graph and tensor.requires_grad) or _is_dual(tensor)):
        if not transforms.is_functorch_wrapped_tensor(tensor):
            return False
        tensor = transforms.get_unwrapped(tensor)
    return True


def _is_dual(tensor: torch.Tensor) -> bool:
    try:
        unpacked: Any = forward_ad.unpack_dual(tensor)  # type: ignore[no-untyped-call]
    except RuntimeError:  # of a batch of `vmap`, which hides what it is made of
        return False
    return unpacked.tangent is not None


def flat_drjit_copy(tensor: torch.Tensor) -> Any:
    """Return a flat Dr.Jit copy of a tensor in Dr.Jit's own memory.

    The scene must not alias memory of the caller, and a recorded kernel would go on reading other memory where the
    first call had it.

    Args:
        tensor: float32 tensor of any shape.
    """
    import drjit as dr
    import mitsuba as mi

    flat = tensor.resolve_neg().reshape(-1)
    if flat.numel() <= FEW:
        few = mi.Float(flat.tolist())
        # A single number would be a literal of the kernels, and that of the first call for ever where a plugin does not
        # show it to Dr.Jit.
        dr.make_opaque(few)
        return few
    flat = flat.contiguous()
    wait_for_torch(flat)
    copy = mi.Float(flat) * dr.opaque(mi.Float, 1)
    dr.eval(copy)
    dr.sync_thread()
    return copy


def wait_for_torch(tensor: torch.Tensor) -> None:
    """Wait for torch's stream of a CUDA tensor: Dr.Jit reads and reuses memory on a stream of its own.

    Args:
        tensor: tensor on any device.
    """
    if tensor.is_cuda:
        torch.cuda.current_stream(tensor.device).synchronize()


class Slot:
    """Place of one torch value in a built scene: its shape, and the parameters of Mitsuba that it sets.

    Args:
        built: the built scene.
        key: key of the parameter.
    """

    def __init__(self, built: BuiltScene, key: str):
        self.key = key
        self._built = built
        params = built.params
        if key in params:
            self.kind, shape = classify(key, params[key])
            self.initial = read_value(params[key], shape)
            self.targets = [key]
        else:
            self.kind, shape = "mesh_transform", (4, 4)
            targets = [key_beside(key, name) for name in (POSITIONS, NORMALS)]
            node = params.properties[targets[0]][2]
            self.initial = built.mesh_to_world.get(node.id(), np.eye(4))
            self.targets = [target for target in targets if target in params]
        assert shape is not None, key  # keys without a derivative, such as texts, are refused before
        self.shape: tuple[int, ...] = shape

    def loses_black(self) -> bool:
        """Return whether derivatives are lost where the value is exactly zero."""
        if self.kind == "mesh_transform":
            return False
        scene = self._built.scene
        node = self._built.params.properties[self.key][2]
        return bool(scene.integrator().parameters(scene).loses_black(node, self.key.rsplit(".", 1)[-1]))

    def is_number_of_kernels(self) -> bool:
        """Return whether Mitsuba reads the value as plain numbers, which become part of kernels."""
        return is_number_of_kernels(*self._class_and_name())

    def check(self, value: Any) -> None:
        """Raise ``SceneError`` for a pose that Mitsuba would store wrongly.

        Args:
            value: value in the shape of the slot.
        """
        if is_turned_by_reflections(*self._class_and_name()):
            check_pose(self.key, self.initial, value)

    def _class_and_name(self) -> tuple[str, str]:
        if self.kind == "mesh_transform":
            return "", "to_world"
        return self._built.params.properties[self.key][2].class_name(), self.key.rsplit(".", 1)[-1]

    def write(self, leaf: Any, originals: Mapping[str, Any]) -> None:
        """Set the parameters of Mitsuba by operations that Dr.Jit differentiates.

        Args:
            leaf: the value as a flat array.
            originals: described values of the targets by key.
        """
        if self.kind == "mesh_transform":
            self._write_mesh(leaf, originals)
            return
        self._built.params[self.key] = as_mitsuba_value(self.kind, self.shape, originals[self.key], leaf)

    def _write_mesh(self, leaf: Any, originals: Mapping[str, Any]) -> None:
        """Set vertices ``T inv(T0) v0``, normals by the inverse transpose; T0 is the described transform."""
        import drjit as dr
        import mitsuba as mi

        entries = [dr.gather(mi.Float, leaf, mi.UInt32(i)) for i in range(16)]
        relative = mi.Matrix4f(*entries) @ mi.Matrix4f(np.linalg.inv(self.initial))
        transform = mi.Transform4f(relative)
        for key in self.targets:
            flat = flat_array(originals[key])
            if key == self.targets[0]:
                moved = transform @ dr.unravel(mi.Point3f, flat)
            elif len(flat):
                moved = dr.normalize(transform @ dr.unravel(mi.Normal3f, flat))
            else:
                continue
            shape = (len(flat) // 3, 3)
            self._built.params[key] = as_mitsuba_value("vertices", shape, originals[key], dr.ravel(moved))


def as_mitsuba_value(kind: str, shape: tuple[int, ...], current: Any, leaf: Any) -> Any:
    """Return a flat array as a value of Mitsuba, by operations that Dr.Jit differentiates.

    Args:
        kind, shape: kind and shape of the torch value (:func:`.parameters.classify`).
        current: value of the parameter, whose type counts.
        leaf: the flat array.
    """
    import drjit as dr
    import mitsuba as mi

    if dr.is_tensor_v(current):
        return type(current)(leaf, shape=shape)
    if kind in ("vector", "points"):
        return dr.unravel(type(current), leaf)
    if kind == "transform":
        n = shape[0]
        entries = [dr.gather(mi.Float, leaf, mi.UInt32(i)) for i in range(n * n)]
        matrix = mi.Matrix4f if n == 4 else mi.Matrix3f
        return type(current)(matrix(*entries))
    return type(current)(leaf)


def dependent_keys(keys: Iterable[str], params: Any) -> list[str]:
    """Return those of ``params`` to be marked as changed together with ``keys``.

    A light with a texture is sampled by a map from texture coordinates to points, which Mitsuba keeps until positions
    change; where those do and normals do not, it makes up new normals.

    Args:
        keys: keys that are written.
        params: ``mitsuba.SceneParameters`` of the scene.
    """
    moved = [key for key in keys if names_array(key, TEXCOORDS)]
    others = [key_beside(key, name) for key in moved for name in (POSITIONS, NORMALS)]
    return [key for key in others if key in params]


def add_normals(keys: Iterable[str], params: Mapping[str, Any]) -> list[str]:
    """Return the keys, and those of ``params`` for the normals that Mitsuba recomputes when positions change.

    Args:
        keys: keys that are written.
        params: values, or parameters of the scene, by key.
    """
    normals = [key_beside(key, NORMALS) for key in keys if names_array(key, POSITIONS)]
    return list(dict.fromkeys((*keys, *(key for key in normals if key in params))))


class SlotTable:
    """Slots of some keys in a built scene, and the described values, which can be put back.

    Args:
        built: the built scene.
        keys: keys of the values.
    """

    def __init__(self, built: BuiltScene, keys: tuple[str, ...]):
        self.built = built
        self.slots = [Slot(built, key) for key in keys]
        # Mitsuba recomputes normals when positions change: both have to go back.
        touched = add_normals([target for slot in self.slots for target in slot.targets], built.params)
        self._check_overlap()
        self._changed_too = dependent_keys(touched, built.params)
        # Copies: what `params` returns may be the plugin's own variable, which changes when it is written.
        self.originals = {target: type(built.params[target])(built.params[target]) for target in touched}

    def _check_overlap(self) -> None:
        owner: dict[str, str] = {}
        for slot in self.slots:
            for target in slot.targets:
                if target in owner:
                    raise SceneError(
                        f"parameters {owner[target]!r} and {slot.key!r} both set {target!r}; ask for one of them."
                    )
                owner[target] = slot.key

    def install(self, leaves: list[Any]) -> None:
        """Write the leaves, one flat array for each slot, and update the scene.

        Args:
            leaves: flat arrays, one for each slot.
        """
        for slot, leaf in zip(self.slots, leaves, strict=True):
            slot.write(leaf, self.originals)
        self._update()

    def restore(self) -> None:
        """Put the described values back."""
        if not self.originals:
            return
        params = self.built.params
        for key, value in self.originals.items():
            params[key] = value
            params.set_dirty(key)
        self._update()

    def _update(self) -> None:
        for key in self._changed_too:
            self.built.params.set_dirty(key)
        self.built.params.update()

"""Base of results with tensors: moved, detached, stacked in batches, flattened to trees of torch.

A record is a dataclass with tensors among its fields. ``torch.utils._pytree``, which ``torch.func``, DDP and FSDP use,
sees its tensors; ``torch.utils.data.default_collate`` stacks records as it stacks dictionaries.
"""

from __future__ import annotations

import copy
import html
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
import torch
from torch.utils import _pytree
from torch.utils.data._utils.collate import collate, default_collate_fn_map

from torchtransient.errors import ArgumentError, ShapeError


@dataclass(frozen=True, eq=False)
class TensorRecord:
    """Base of a frozen dataclass whose fields, and the entries of whose ``others``, are tensors, settings or None.

    Two records are equal if their settings are, and their tensors hold the same numbers of the same dtype, on any
    device (derive dataclasses with ``eq=False``).

    Attributes:
        notes: fields about the making of the record. They do not enter comparisons; :meth:`merged_notes` makes those of
            a batch. All other settings must agree in a batch.
    """

    notes: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        _pytree.register_pytree_node(cls, _taken_apart, _put_together, flatten_with_keys_fn=_taken_apart_with_keys)
        default_collate_fn_map[cls] = _collated

    if not TYPE_CHECKING:  # for type checkers there are no other attributes

        def __getattr__(self, name: str) -> Any:
            """Raise AttributeError, with the names of the tensors if a record was taken for one."""
            what = f"'{type(self).__name__}' object has no attribute '{name}'"
            own = {field.name for field in fields(self)}  # of a record that is not whole yet
            if not name.startswith("_") and name not in own and hasattr(torch.Tensor, name):
                what += f": it is no tensor, it holds some ({', '.join(self.tensors())}); take one of them"
            raise AttributeError(what, name=name, obj=self)

    # ------------------------------------------------------------------------------------------------------ as torch

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return the tensors by name, those in ``others`` included."""
        return {name: value for name, value in self._entries().items() if isinstance(value, torch.Tensor)}

    def map(self, function: Callable[[torch.Tensor], torch.Tensor]) -> Self:
        """Return a copy with ``function`` applied to every tensor."""
        return self._with({name: function(tensor) for name, tensor in self.tensors().items()})

    def to(self, *args: Any, **keywords: Any) -> Self:
        """Return a copy with every tensor moved or cast, as ``torch.Tensor.to``.

        As in modules, a dtype applies to real numbers; complex tensors take the complex dtype of its precision, and
        whole numbers and truth values keep theirs.
        """

        def moved(tensor: torch.Tensor) -> torch.Tensor:
            values = [_dtype_for(tensor, value) for value in args]
            named = {name: _dtype_for(tensor, value) for name, value in keywords.items()}
            return tensor.to(*values, **named)

        return self.map(moved)

    def cpu(self) -> Self:
        """Return a copy on the CPU."""
        return self.to("cpu")

    def cuda(self, device: Any = None) -> Self:
        """Return a copy on the current CUDA device, or on ``device``."""
        return self.map(lambda tensor: tensor.cuda(device))

    def detach(self) -> Self:
        """Return a copy without gradients."""
        return self.map(torch.Tensor.detach)

    def clone(self) -> Self:
        """Return a copy in memory of its own, contiguous."""
        return self.map(lambda tensor: tensor.clone(memory_format=torch.contiguous_format))

    def pin_memory(self) -> Self:
        """Return a copy in pinned memory, as ``DataLoader(pin_memory=True)`` asks for."""
        return self.map(torch.Tensor.pin_memory)

    @classmethod
    def stack(cls, records: Sequence[Self]) -> Self:
        """Stack records along a new leading dimension, as ``torch.stack``.

        Args:
            records: records of this class with equal settings, apart from ``notes``, and equal shapes.

        Raises:
            ArgumentError: for entries of other classes.
            ShapeError: for different settings or shapes, and for no record.
        """
        return cls._joined(records, lambda tensors: torch.stack(list(tensors)))

    @classmethod
    def cat(cls, records: Sequence[Self]) -> Self:
        """Concatenate records along their leading dimension, as ``torch.cat``; else as :meth:`stack`."""
        return cls._joined(records, lambda tensors: torch.cat(list(tensors)))

    @classmethod
    def merged_notes(cls, records: Sequence[Self]) -> dict[str, Any]:
        """Return the ``notes`` of a batch. Raises ``ShapeError`` for records that were made differently."""
        return {}

    @classmethod
    def _joined(cls, records: Sequence[Self], join: Callable[[Sequence[torch.Tensor]], torch.Tensor]) -> Self:
        if not isinstance(records, Sequence) or isinstance(records, (str, bytes)):
            raise ArgumentError(f"a batch of {cls.__name__}: expected a list of them, got {type(records).__name__}.")
        for k, record in enumerate(records):
            if not isinstance(record, cls):
                kind = type(record).__name__
                hint = f" {kind}.stack is for those of its class." if isinstance(record, TensorRecord) else ""
                raise ArgumentError(f"a batch of {cls.__name__}: expected these alone, got {kind} as entry {k}.{hint}")
        if len(records) == 0:
            raise ShapeError(f"a batch of {cls.__name__}: expected at least one, got none.")
        first = records[0]
        for other in records[1:]:
            for (name, a), b in zip(first._settings().items(), other._settings().values(), strict=True):
                if a != b:
                    raise ShapeError(
                        f"a batch of {cls.__name__}: expected the same {name} in all of them, got {a} and {b}. Put "
                        "together the tensors alone, or records that mean the same."
                    )
        tensors = {}
        for name in first.tensors():
            shapes = [tuple(record.tensors()[name].shape) for record in records]
            try:
                tensors[name] = join([record.tensors()[name] for record in records])
            except RuntimeError as error:
                found = ", ".join(map(str, dict.fromkeys(shapes)))
                raise ShapeError(
                    f"a batch of {cls.__name__}: {name} cannot be put together, got {found}: {error}"
                ) from error
        return first._with(tensors | cls.merged_notes(records))

    # -------------------------------------------------------------------------------------------------- taking apart

    def _entries(self) -> dict[str, Any]:
        found = {field.name: getattr(self, field.name) for field in fields(self)}
        return {**found, **found.pop("others", {})}

    def _settings(self) -> dict[str, Any]:
        """Return the entries that must agree in a batch: names of the tensors, settings without notes."""
        return {
            "tensors": tuple(self.tensors()),
            **{
                name: value
                for name, value in self._entries().items()
                if not isinstance(value, torch.Tensor) and name not in self.notes
            },
        }

    def _with(self, entries: Mapping[str, Any]) -> Self:
        """Return a copy with some entries replaced."""
        others: Mapping[str, Any] = getattr(self, "others", {})
        changes = {name: value for name, value in entries.items() if name not in others}
        if others:
            changes["others"] = {name: entries.get(name, value) for name, value in others.items()}
        return replace(self, **changes)

    # ----------------------------------------------------------------------------------------------------- compared

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        assert isinstance(other, TensorRecord)
        return same(self._settings(), other._settings()) and same(self.tensors(), other.tensors())

    def __hash__(self) -> int:
        return hash((type(self), *((name, *tensor.shape) for name, tensor in self.tensors().items())))

    # -------------------------------------------------------------------------------------------------------- shown

    def _shown(self) -> dict[str, str]:
        """Return a line for each tensor and each setting with a value, by name."""
        shown = {name: _described(tensor) for name, tensor in self.tensors().items()}
        for name, value in self._entries().items():
            if name not in shown and name not in self.notes and value not in (None, (), {}):
                shown[name] = "/".join(value) if name == "channels" else _short(value)
        return {**shown, **self._shown_notes()}

    def _shown_notes(self) -> dict[str, str]:
        return {}

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{name}={text}' for name, text in self._shown().items())})"

    def _repr_html_(self) -> str:
        """Return a table for notebooks."""
        rows = "".join(
            f"<tr><th style='text-align:left'>{html.escape(name)}</th>"
            f"<td style='text-align:left'>{html.escape(text)}</td></tr>"
            for name, text in self._shown().items()
        )
        return f"<table><caption>{html.escape(type(self).__name__)}</caption>{rows}</table>"


def _described(tensor: torch.Tensor) -> str:
    kind = str(tensor.dtype).removeprefix("torch.")
    where = "" if tensor.device.type == "cpu" else f" on {tensor.device}"
    return f"{kind} {tuple(tensor.shape)}{where}{', with gradient' if tensor.requires_grad else ''}"


def _short(value: Any) -> str:
    text = f"{len(value)} of them" if isinstance(value, tuple) and len(value) > 4 else str(value)
    return text if len(text) <= 100 else text[:97] + "..."


def _dtype_for(tensor: torch.Tensor, value: Any) -> Any:
    if not isinstance(value, torch.dtype):
        return value
    if tensor.is_complex():
        return value if value.is_complex else value.to_complex()
    return value if tensor.is_floating_point() else tensor.dtype


class _Rest:
    """Record without its tensors, the context of a tree. Equal if the settings are."""

    def __init__(self, record: TensorRecord):
        self.names = _leaves_of(record)
        self.record = _unchecked(record, dict.fromkeys(self.names))
        settings = self.record._settings()
        self._settings = {"class": type(record), **settings, "tensors": tuple(self.names)}

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Rest) and self._settings == other._settings

    def __hash__(self) -> int:
        return hash((self._settings["class"], *self.names))


def _leaves_of(record: TensorRecord) -> list[str]:
    """Return the names of the leaves of a record: its tensors, or the objects that a tree put in their places."""
    found: list[str] | None = record.__dict__.get("_leaves")
    return list(record.tensors()) if found is None else found


def _taken_apart(record: TensorRecord) -> tuple[list[Any], _Rest]:
    entries, rest = record._entries(), _Rest(record)
    return [entries[name] for name in rest.names], rest


def _taken_apart_with_keys(record: TensorRecord) -> tuple[list[Any], _Rest]:
    leaves, rest = _taken_apart(record)
    return [(_pytree.GetAttrKey(name), leaf) for name, leaf in zip(rest.names, leaves, strict=True)], rest


def _put_together(leaves: Any, rest: _Rest) -> Any:
    given = dict(zip(rest.names, leaves, strict=True))
    if all(isinstance(leaf, torch.Tensor) for leaf in given.values()):
        return rest.record._with(given)
    # Trees carry anything: dimensions, names, objects that stand for tensors.
    record = _unchecked(rest.record, given)
    object.__setattr__(record, "_leaves", rest.names)
    return record


def _unchecked(record: TensorRecord, entries: Mapping[str, Any]) -> TensorRecord:
    """Return a copy with any objects in the places of tensors, which the class itself would refuse."""
    twin, others = copy.copy(record), getattr(record, "others", {})
    twin.__dict__.pop("_leaves", None)
    for name in entries.keys() - others.keys():
        object.__setattr__(twin, name, entries[name])
    if others:
        object.__setattr__(twin, "others", {name: entries.get(name, value) for name, value in others.items()})
    return twin


def _collated(batch: Any, *, collate_fn_map: Any = None) -> Any:
    def join(tensors: Sequence[torch.Tensor]) -> torch.Tensor:
        # Torch's own way: in a worker process the batch is made in shared memory.
        together: torch.Tensor = collate(list(tensors), collate_fn_map=collate_fn_map)
        return together

    return type(batch[0])._joined(batch, join)


def same(a: Any, b: Any) -> bool:
    """Compare tensors, arrays, or dictionaries of them.

    Args:
        a, b: values on any device.

    Returns:
        True for equal shapes, dtypes and values, with NaN in the same places.
    """
    if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor):
        if a.shape != b.shape or a.dtype != b.dtype:
            return False
        here, there = a.detach().cpu(), b.detach().cpu()
        return bool(torch.equal(here, there)) or bool(((here == there) | (here.isnan() & there.isnan())).all())
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return np.shape(a) == np.shape(b) and bool(np.array_equal(a, b))
    return bool(a == b)

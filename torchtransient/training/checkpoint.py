"""Checkpoints of a run: written whole or not at all, read without executing anything."""

from __future__ import annotations

import os
import pickle
import random
import warnings
import zipfile
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from torch import nn
from torch.nn.parallel import DistributedDataParallel
from torch.nn.parameter import is_lazy

from torchtransient.array_files.part_files import sweep_parts, whole_file
from torchtransient.checks import check_folder, check_special, count, path_of, shown
from torchtransient.errors import (
    ArgumentError,
    ShapeError,
    StorageError,
    TorchTransientError,
    TorchTransientWarning,
    UnitError,
)

_PLAIN = (type(None), bool, int, float, complex, str, bytes, torch.Size, torch.dtype, torch.device)

def plain(value: Any, where: str) -> Any:
    """Return a state as plain data: mappings as dictionaries, numbers and arrays of NumPy as those of Python and torch.

    Args:
        value: state of any kind; tensors are detached.
        where: place of the state, for the message.

    Raises:
        StorageError: for objects that are no data, with their place.
    """
    if type(value) in _PLAIN:
        return value
    if isinstance(value, torch.Tensor):
        return value.detach()
    if isinstance(value, np.generic) and type(value.item()) in _PLAIN:
        return value.item()
    if isinstance(value, np.ndarray):
        return torch.from_numpy(value.astype(value.dtype.newbyteorder("="), copy=True))
    if isinstance(value, Mapping):
        items = {_key(key, where): plain(entry, f"{where}[{key!r}]") for key, entry in value.items()}
        if not hasattr(value, "_metadata"):
            return items
        # The versions of modules, by which they convert what older ones have written.
        made = OrderedDict(items)
        made._metadata = plain(value._metadata, f"{where}._metadata")  # type: ignore[attr-defined]
        return made
    if type(value) in (list, tuple, set):
        return type(value)(plain(entry, f"{where}[{n}]") for n, entry in enumerate(value))
    raise StorageError(
        f"save_checkpoint: {where} is a {type(value).__name__}, expected data: numbers, texts, tensors, lists, "
        "dictionaries. Anything else would have to be executed when it is read."
    )


def _key(key: Any, where: str) -> Any:
    if type(key) in (str, int, bool, float, bytes, type(None)):
        return key
    if isinstance(key, tuple):
        return tuple(_key(entry, where) for entry in key)
    raise StorageError(f"save_checkpoint: a key of {where} is a {type(key).__name__}, expected a text or a number.")


def random_state() -> dict[str, Any]:
    """Return the states of the generators of Python, NumPy (the legacy one of the process), torch and its CUDA devices.
    """
    numpy = np.random.get_state(legacy=False)  # noqa: NPY002 (others draw from it)
    assert isinstance(numpy, dict)
    version, words, gauss = random.getstate()
    found = {
        "python": {"version": version, "words": list(words), "gauss": gauss},
        "numpy": {
            "bit_generator": numpy["bit_generator"],
            "key": torch.from_numpy(numpy["state"]["key"].astype(np.int64)),
            "pos": int(numpy["state"]["pos"]),
            "has_gauss": int(numpy["has_gauss"]),
            "gauss": float(numpy["gauss"]),
        },
        "torch": torch.get_rng_state(),
    }
    if torch.cuda.is_available():
        found["cuda"] = torch.cuda.get_rng_state_all()
    return found


def check_random_state(state: Any) -> None:
    """Check a state of generators, and change nothing.

    Args:
        state: result of :func:`random_state`.

    Raises:
        StorageError: for a state of another number of CUDA devices, and other objects.
    """
    lacking = [name for name in ("python", "numpy", "torch") if not isinstance(state, dict) or name not in state]
    if lacking:
        raise StorageError(f"load_checkpoint: its random numbers lack those of {', '.join(lacking)}.")
    devices = len(state.get("cuda", ()))
    here = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if devices != here:
        raise StorageError(
            f"load_checkpoint: its random numbers are of {devices} CUDA devices, here are {here}. Use as many, or "
            "leave them alone with random=False."
        )


def set_random_state(state: dict[str, Any]) -> None:
    """Put the states of all generators back.

    Args:
        state: result of :func:`random_state`.

    Raises:
        StorageError: for broken states.
    """
    try:
        python, numpy = state["python"], state["numpy"]
        words = tuple(python["words"])
        key = numpy["key"].numpy().astype(np.uint32)
        random.setstate((python["version"], words, python["gauss"]))
        legacy = (numpy["bit_generator"], key, numpy["pos"], numpy["has_gauss"], numpy["gauss"])
        np.random.set_state(legacy)  # noqa: NPY002
        torch.set_rng_state(state["torch"])
        if state.get("cuda"):
            torch.cuda.set_rng_state_all(state["cuda"])
    except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        raise StorageError(f"load_checkpoint: its random numbers cannot be used: {error}") from error


# Entries of torch's optimisers that have the shape of their parameter.
_OF_SHAPE = (
    "exp_avg", "exp_avg_sq", "max_exp_avg_sq", "exp_inf", "momentum_buffer", "square_avg", "grad_avg", "sum",
    "acc_delta", "ax", "prev",
)  # fmt: skip


def _kind_of(optimizer: torch.optim.Optimizer) -> str:
    return f"{type(optimizer).__module__}.{type(optimizer).__name__}"


def check_optimizer(name: str, optimizer: torch.optim.Optimizer, state: Any, kind: str | None) -> None:
    """Check a state of an optimiser, and change nothing.

    Args:
        name: name of the part.
        optimizer: optimiser of torch.
        state: state that is to be loaded.
        kind: class that has written it, with its module, None if unknown.

    Raises:
        StorageError, ShapeError: for a state of another kind, or of other groups or shapes.
    """
    groups = state.get("param_groups") if isinstance(state, dict) else None
    entries = state.get("state") if isinstance(state, dict) else None
    if not isinstance(groups, list) or not isinstance(entries, dict):
        raise StorageError(f"load_checkpoint: the part {name!r} is no state of an optimiser.")
    # Modules move from version to version, but an Adam of one's own is not torch's.
    mine, theirs = ((one.startswith("torch."), one.rpartition(".")[2]) for one in (_kind_of(optimizer), str(kind)))
    if kind is not None and mine != theirs:
        raise StorageError(
            f"load_checkpoint: the state of {name!r} is of another kind of optimiser, {shown(kind)}; here is "
            f"{_kind_of(optimizer)!r}."
        )
    here = [len(group["params"]) for group in optimizer.param_groups]
    there = [len(group["params"]) for group in groups]
    if here != there:
        raise StorageError(
            f"load_checkpoint: {name!r} has groups of {there} parameters in the file, here of {here}: make the "
            "optimiser of the same parameters, in the same order."
        )
    for own, group in zip(optimizer.param_groups, groups, strict=True):
        for parameter, number in zip(own["params"], group["params"], strict=True):
            for entry, value in entries.get(number, {}).items():
                wrong = isinstance(value, torch.Tensor) and entry in _OF_SHAPE and value.shape != parameter.shape
                # Complex numbers are kept as pairs.
                if wrong and not parameter.is_complex():
                    raise ShapeError(
                        f"load_checkpoint: {entry!r} of parameter {number} of {name!r}: expected shape "
                        f"{tuple(parameter.shape)}, the file has {tuple(value.shape)}."
                    )


_FORMAT, _VERSION = "torchtransient checkpoint", 1
_ENTRIES = ("format", "version", "step", "parts", "values", "random", "libraries")


@dataclass(frozen=True)
class Checkpoint:
    """Contents of a checkpoint beside the states of its parts. Returned by :func:`load_checkpoint`.

    Attributes:
        step: number of steps that are done, which is the step to go on with.
        values: plain data, as they were given.
        libraries: versions that wrote it, by name.
        ranks: number of processes.
    """

    step: int
    _: KW_ONLY
    values: dict[str, Any] = field(default_factory=dict)
    libraries: dict[str, str] = field(default_factory=dict)
    ranks: int = 1


def save_checkpoint(
    path: str | os.PathLike[str], parts: Mapping[str, Any], *, step: int, values: Mapping[str, Any] | None = None
) -> None:
    """Write the state of a run, from which :func:`load_checkpoint` goes on to the bit. ::

        parts = {"model": model, "optimizer": optimizer, "schedule": schedule, "batches": batches, "noise": generator}
        tt.training.save_checkpoint("run.pt", parts, step=step + 1, values={"losses": losses})

    Beside parts and values it holds the random numbers of Python, NumPy, torch and CUDA of this process, and versions
    of libraries. Written beside ``path``, synchronised to the disk, and then put in its place: whenever a run is
    killed, ``path`` is the last checkpoint that was finished, whole, and the next one removes what was half written. In
    a process group all ranks call this, and the first one writes; parts are its own, random numbers and generators
    those of every rank.

    Args:
        path: path of the file.
        parts: objects by name with ``state_dict`` and ``load_state_dict`` (modules, optimisers, schedules, a
            GradScaler, :class:`Batches`), and generators of torch. Modules inside of DistributedDataParallel or
            ``torch.compile`` are stored without them, so that the checkpoint can be read with and without.
        step: number of steps that are done.
        values: plain data (numbers, texts, tensors, lists, dictionaries) that come back.

    Raises:
        StorageError: for states that could not be read without executing something, and where nothing can be written.
        ArgumentError: for parts without a state.

    Not in the checkpoint: the source of the network's data beyond their position, buffers that modules do not put into
    their state, and attributes.
    """
    place = path_of(path, "save_checkpoint")
    parts = dict(parts)
    failure: str | None = "its parts or values are no state; see its own error."
    # All ranks learn what went wrong in one of them: none is left waiting for the others.
    try:
        content = _content(parts, step, values)
        failure = None
    finally:
        own_generators = {name: one.get_state() for name, one in _generators(parts).items()}
        told = _of_all_ranks({"random": random_state(), "generators": own_generators, "failure": failure})
    failures = [f"rank {rank}: {one['failure']}" for rank, one in enumerate(told) if one["failure"] is not None]
    if failures:
        raise StorageError(f"save_checkpoint: {place} was not written. {' '.join(failures)}")
    content["random"] = [one["random"] for one in told]
    for name in _generators(parts):
        content["parts"][name]["generators"] = [one["generators"].get(name) for one in told]
    own = _written(place, content) if _rank() == 0 else None
    failure = _told_by_first(None if own is None else str(own))
    if failure is not None:
        reason = failure.removeprefix("save_checkpoint: ")
        raise StorageError(f"save_checkpoint: {place} cannot be written: {reason}") from own


def load_checkpoint(path: str | os.PathLike[str], parts: Mapping[str, Any], *, random: bool = True) -> Checkpoint:
    """Put the state of a run back into its parts, and return the step to go on with.

    A run that was stopped and goes on ends with the same weights as one that was not, to the bit, where a step depends
    on parts, random numbers and step alone, and sums are added in the same order: same libraries and machine,
    ``tt.threads(1)``. Other libraries are warned of (TorchTransientWarning).

    Nothing in the file is executed (``weights_only``), and nothing is changed before the whole file has been checked:
    its sums, format, names of parts, names and shapes of the tensors of modules, kind, groups, settings and moments of
    optimisers, order of :class:`Batches` (of other parts: the errors of their ``check_state_dict(state)``, if they have
    one). A part that still refuses its state afterwards raises an error that says so. Every rank reads the file.

    Args:
        path: path of the file.
        parts: objects of the same kinds as those of :func:`save_checkpoint`, made anew, under the same names.
        random: put the random numbers of this process back, which takes as many ranks as have written it; with False,
            and all draws made by :class:`Seeds`, the number of ranks may change.

    Raises:
        StorageError: for a file that is not there, torn, or another kind.
        ShapeError: for tensors of other shapes.
    """
    source = path_of(path, "load_checkpoint")
    given, where = dict(parts), str(source)
    content = _read(source)
    states, ranks = content["parts"], len(content["random"])
    if states.keys() != given.keys():
        raise StorageError(
            f"load_checkpoint: {where} has the parts {', '.join(states) or '(none)'}, expected {', '.join(given)}."
        )
    kinds = content.get("optimizers", {})  # older files have none
    for name, part in given.items():
        if isinstance(part, torch.optim.Optimizer):
            check_optimizer(name, part, states[name], kinds.get(name))
        else:
            _check(name, part, states[name])
    if random and ranks != _size():
        raise StorageError(
            f"load_checkpoint: {where} has the random numbers of {ranks} ranks, expected those of {_size()}. Start as "
            "many, or use random=False."
        )
    if random:
        check_random_state(content["random"][_rank()])
    _compare(where, content["libraries"])
    for name, part in given.items():
        _put_back(name, part, states[name])
    # Last: putting other states back may draw.
    if random:
        set_random_state(content["random"][_rank()])
    return Checkpoint(content["step"], values=content["values"], libraries=content["libraries"], ranks=ranks)


# ------------------------------------------------------------------------------------------------------------ parts


def _content(parts: Mapping[str, Any], step: int, values: Mapping[str, Any] | None) -> dict[str, Any]:
    """All of a checkpoint but the random numbers."""
    return {
        "format": _FORMAT,
        "version": _VERSION,
        "step": count("save_checkpoint: step", step, 0, UnitError),
        "parts": {name: _state_of(name, part) for name, part in parts.items()},
        "optimizers": {n: _kind_of(one) for n, one in parts.items() if isinstance(one, torch.optim.Optimizer)},
        "values": plain(dict(values or {}), "values"),
        "libraries": _libraries(),
    }


def _inner(part: Any) -> Any:
    """Return the module inside of DistributedDataParallel or torch.compile; they share its state, under other names."""
    while True:
        if isinstance(part, DistributedDataParallel):
            part = part.module
        elif isinstance(part, nn.Module) and isinstance(getattr(part, "_orig_mod", None), nn.Module):
            part = part._orig_mod
        else:
            return part


def _generators(parts: Mapping[str, Any]) -> dict[str, torch.Generator]:
    return {name: part for name, part in parts.items() if isinstance(part, torch.Generator)}


def _state_of(name: str, part: Any) -> Any:
    part = _inner(part)
    if isinstance(part, torch.Generator):
        return {"device": part.device.type}
    if not (hasattr(part, "state_dict") and hasattr(part, "load_state_dict")):
        raise ArgumentError(
            f"save_checkpoint: expected the part {name!r} to have state_dict and load_state_dict, or to be a generator "
            f"of torch, got {type(part).__name__}. Plain data belong into values."
        )
    return plain(part.state_dict(), name)


def _check(name: str, part: Any, state: Any) -> None:
    """Check a state, and change nothing."""
    part = _inner(part)
    if isinstance(part, torch.Generator):
        if not isinstance(state, dict) or state.get("device") != part.device.type or "generators" not in state:
            raise StorageError(f"load_checkpoint: the part {name!r} is no state of a generator on {part.device.type}.")
        if len(state["generators"]) != _size():
            raise StorageError(
                f"load_checkpoint: the part {name!r} is a generator of each of {len(state['generators'])} ranks, "
                f"expected {_size()}. Start as many, or draw by Seeds.generator, which needs no state."
            )
    elif hasattr(part, "check_state_dict"):
        part.check_state_dict(state)
    elif isinstance(part, nn.Module):
        expected = part.state_dict()
        if not isinstance(state, dict) or state.keys() != expected.keys():
            own = set(state) if isinstance(state, dict) else set()
            lacks, has = sorted(expected.keys() - own), sorted(own - expected.keys())
            raise StorageError(
                f"load_checkpoint: the state of {name!r} is of another module: it lacks "
                f"{', '.join(lacks) or 'nothing'} and has {', '.join(map(str, has)) or 'nothing'} beyond."
            )
        for key, tensor in expected.items():
            # Lazy modules have no shapes yet.
            known = isinstance(tensor, torch.Tensor) and not is_lazy(tensor)
            if known and tensor.shape != getattr(state[key], "shape", None):
                came = tuple(getattr(state[key], "shape", ()))
                raise ShapeError(
                    f"load_checkpoint: {key!r} of {name!r}: expected shape {tuple(tensor.shape)}, the file has {came}."
                )
            if known and tensor.dtype != state[key].dtype:
                raise ShapeError(
                    f"load_checkpoint: {key!r} of {name!r}: expected {tensor.dtype}, the file has {state[key].dtype}; "
                    "load into a module of that precision, and convert it afterwards."
                )


def _put_back(name: str, part: Any, state: Any) -> None:
    part = _inner(part)
    try:
        if isinstance(part, torch.Generator):
            part.set_state(state["generators"][_rank()])
        else:
            part.load_state_dict(state)
    except TorchTransientError:
        raise
    except (KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
        raise StorageError(
            f"load_checkpoint: the part {name!r} does not take its state: {error}. All parts have to be made anew: "
            "those before it have theirs already."
        ) from error


# ------------------------------------------------------------------------------------------------------------- file


def _written(path: Path, content: dict[str, Any]) -> Exception | None:
    """Write a checkpoint and return the error, None without one. A full disk is an OSError, or a RuntimeError of
    torch's.
    """
    try:
        check_folder(path, "save_checkpoint")
        sweep_parts(path.parent)
        with whole_file(path, "save_checkpoint") as unfinished, unfinished.open("wb") as file:
            torch.save(content, file)
    except (StorageError, OSError, RuntimeError) as error:
        return error
    return None


def _read(path: Path) -> dict[str, Any]:
    def refused(why: str, error: BaseException | None = None) -> StorageError:
        found = StorageError(f"load_checkpoint: {path} {why}")
        found.__cause__ = error
        return found

    check_special(path, "load_checkpoint")
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
        content = None if damaged else torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise refused("is not there.", error) from None
    except OSError as error:
        raise refused(f"cannot be read: {error}", error) from None
    except pickle.UnpicklingError as error:
        raise refused("holds objects that would have to be executed: it is no checkpoint of ours.", error) from None
    except (zipfile.BadZipFile, RuntimeError, EOFError, ValueError, KeyError, NotImplementedError) as error:
        raise refused("is torn, or no checkpoint. Take an earlier one.", error) from None
    if damaged:
        raise refused(f"is damaged: the sum of {damaged} is wrong. Take an earlier one.")
    if not isinstance(content, dict) or content.get("format") != _FORMAT:
        raise refused("is a file of torch, and no checkpoint of save_checkpoint.")
    if content.get("version") != _VERSION:
        raise refused(f"is a checkpoint of version {content.get('version')}, expected {_VERSION}.")
    missing = [name for name in _ENTRIES if name not in content]
    if missing:
        raise refused(f"lacks {', '.join(missing)}.")
    return content


def _libraries() -> dict[str, str]:
    import torchtransient

    # torch itself says for which device it was built ("2.6.0+cu124"), what the metadata of some builds leave out.
    others = {name: version(name) for name in ("mitsuba", "drjit", "numpy", "kornia")}
    return {"torchtransient": torchtransient.__version__, "torch": str(torch.__version__), **others}


def _compare(where: str, written: Mapping[str, str]) -> None:
    here = _libraries()
    others = [f"{name} {written.get(name)} (here {own})" for name, own in here.items() if written.get(name) != own]
    if others:
        warnings.warn(
            f"load_checkpoint: {where} was written with {', '.join(others)}: the run goes on, but not to the bit.",
            TorchTransientWarning,
            stacklevel=3,
        )


# ------------------------------------------------------------------------------------------------------------ ranks


def _in_group() -> bool:
    return dist.is_available() and dist.is_initialized()


def _rank() -> int:
    return dist.get_rank() if _in_group() else 0


def _size() -> int:
    return dist.get_world_size() if _in_group() else 1


def _of_all_ranks(state: dict[str, Any]) -> list[dict[str, Any]]:
    if not _in_group():
        return [state]
    found: list[Any] = [None] * _size()
    dist.all_gather_object(found, state)
    return found


def _told_by_first(failure: str | None) -> str | None:
    """Return the failure of the first rank; all wait for it, so that the file is there when they go on."""
    if not _in_group():
        return failure
    said = [failure]
    dist.broadcast_object_list(said, src=0)
    return said[0]

"""Whether a state is one of an optimiser: torch takes those of other kinds, and fails at the next step."""

from __future__ import annotations

from typing import Any

import torch

from torchtransient.checks import shown
from torchtransient.errors import ShapeError, StorageError

# Entries of torch's optimisers that have the shape of their parameter.
_OF_SHAPE = (
    "exp_avg", "exp_avg_sq", "max_exp_avg_sq", "exp_inf", "momentum_buffer", "square_avg", "grad_avg", "sum",
    "acc_delta", "ax", "prev",
)  # fmt: skip


def kind_of(optimizer: torch.optim.Optimizer) -> str:
    """The name of its class, with the module."""
    return f"{type(optimizer).__module__}.{type(optimizer).__qualname__}"


def put_back_optimizer(optimizer: torch.optim.Optimizer, state: dict[str, Any]) -> None:
    """Load a state that was checked. What schedules and callers keep in groups, and the state lacks, stays as it is
    here: torch would delete it, and some schedules fail without it at their next step.
    """
    groups = [
        {**{key: value for key, value in own.items() if key not in group and _is_added(optimizer, key)}, **group}
        for own, group in zip(optimizer.param_groups, state["param_groups"], strict=True)
    ]
    optimizer.load_state_dict({**state, "param_groups": groups})


def check_optimizer(
    name: str, optimizer: torch.optim.Optimizer, state: Any, kind: Any, is_same_torch: bool
) -> None:  # fmt: skip
    """Raise StorageError or ShapeError for a state of another kind, or of other groups, settings or shapes. Changes
    nothing.

    ``kind``: :func:`kind_of` the optimiser that has written it, None for what is not known. ``is_same_torch``: whether
    the state is of the same torch; others may have other settings.
    """
    groups = state.get("param_groups") if isinstance(state, dict) else None
    entries = state.get("state") if isinstance(state, dict) else None
    if not isinstance(groups, list) or not isinstance(entries, dict):
        raise StorageError(f"load_checkpoint: the part {name!r} is no state of an optimiser.")
    if kind is not None and not _is_same_kind(kind, kind_of(optimizer)):
        raise StorageError(
            f"load_checkpoint: the state of {name!r} is of another kind of optimiser, {shown(kind)}; here is "
            f"{kind_of(optimizer)!r}."
        )
    here = [len(group["params"]) for group in optimizer.param_groups]
    there = [len(group["params"]) for group in groups]
    if here != there:
        raise StorageError(
            f"load_checkpoint: {name!r} has groups of {there} parameters in the file, here of {here}: make the "
            "optimiser of the same parameters, in the same order."
        )
    for own, group in zip(optimizer.param_groups, groups, strict=True):
        lacks = sorted(key for key in own.keys() - group.keys() if not _is_added(optimizer, key))
        if is_same_torch and lacks:
            raise StorageError(
                f"load_checkpoint: the state of {name!r} is of another kind of optimiser, it lacks {', '.join(lacks)}; "
                f"here is {type(optimizer).__name__}."
            )
        for parameter, number in zip(own["params"], group["params"], strict=True):
            for entry, value in entries.get(number, {}).items():
                wrong = isinstance(value, torch.Tensor) and entry in _OF_SHAPE and value.shape != parameter.shape
                # Of what torch keeps of complex numbers as pairs, and of lazy parameters, nothing is known yet.
                if wrong and not parameter.is_complex() and not torch.nn.parameter.is_lazy(parameter):
                    raise ShapeError(
                        f"load_checkpoint: {entry!r} of parameter {number} of {name!r}: expected shape "
                        f"{tuple(parameter.shape)}, the file has {tuple(value.shape)}."
                    )


def _is_same_kind(there: Any, here: str) -> bool:
    """Modules count by their package: within it they move from version to version. A script's own class is of the
    module `__main__` when it is run, and of another one when it is imported.
    """
    if not isinstance(there, str):
        return False
    packages = {kind.partition(".")[0] for kind in (there, here)}
    return there.rpartition(".")[2] == here.rpartition(".")[2] and (len(packages) == 1 or "__main__" in packages)


def _is_added(optimizer: torch.optim.Optimizer, key: str) -> bool:
    """Whether an entry of groups is none of the optimiser's own settings: a schedule's ``initial_lr`` is not."""
    return key != "params" and key not in optimizer.defaults

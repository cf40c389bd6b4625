"""Whether a state is one of an optimiser: torch takes those of other kinds, and fails at the next step."""

from __future__ import annotations

from typing import Any

import torch

from torchtransient.errors import ShapeError, StorageError

# Entries of torch's optimisers that have the shape of their parameter.
_OF_SHAPE = (
    "exp_avg", "exp_avg_sq", "max_exp_avg_sq", "exp_inf", "momentum_buffer", "square_avg", "grad_avg", "sum",
    "acc_delta", "ax", "prev",
)  # fmt: skip


def check_optimizer(name: str, optimizer: torch.optim.Optimizer, state: Any, is_same_torch: bool) -> None:
    """Raise StorageError or ShapeError for a state of other groups, settings or shapes. Changes nothing.

    ``is_same_torch``: whether the state is of the same torch; others may have other settings.
    """
    groups = state.get("param_groups") if isinstance(state, dict) else None
    entries = state.get("state") if isinstance(state, dict) else None
    if not isinstance(groups, list) or not isinstance(entries, dict):
        raise StorageError(f"load_checkpoint: the part {name!r} is no state of an optimiser.")
    here = [len(group["params"]) for group in optimizer.param_groups]
    there = [len(group["params"]) for group in groups]
    if here != there:
        raise StorageError(
            f"load_checkpoint: {name!r} has groups of {there} parameters in the file, here of {here}: make the "
            "optimiser of the same parameters, in the same order."
        )
    for own, group in zip(optimizer.param_groups, groups, strict=True):
        lacks = sorted(own.keys() - group.keys())
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

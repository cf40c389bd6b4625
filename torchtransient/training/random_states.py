"""The random numbers of a process: of Python, NumPy and torch, as plain data."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import torch

from torchtransient.errors import StorageError


def random_state() -> dict[str, Any]:
    """Where the generators of Python, NumPy (the legacy one of the process), torch and its CUDA devices stand."""
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
    """Raises StorageError where a state is of another number of CUDA devices, or none. Changes nothing."""
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
    """Put all of them back. Raises StorageError as `check_random_state`, and for what is no such state."""
    check_random_state(state)
    devices = len(state.get("cuda", ()))
    try:
        python, numpy = state["python"], state["numpy"]
        words = tuple(python["words"])
        key = numpy["key"].numpy().astype(np.uint32)
        random.setstate((python["version"], words, python["gauss"]))
        legacy = (numpy["bit_generator"], key, numpy["pos"], numpy["has_gauss"], numpy["gauss"])
        np.random.set_state(legacy)  # noqa: NPY002
        torch.set_rng_state(state["torch"])
        if devices:
            torch.cuda.set_rng_state_all(state["cuda"])
    except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        raise StorageError(f"load_checkpoint: its random numbers cannot be used: {error}") from error

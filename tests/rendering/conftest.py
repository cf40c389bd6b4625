"""Fixtures around the small room."""

from __future__ import annotations

import pytest
import torch

import torchtransient as tt
from tools.small_room import VARIANT, make_room


@pytest.fixture
def room() -> dict:
    """The room as a dictionary that a test may change."""
    return make_room()


@pytest.fixture(scope="module")
def room_scene() -> tt.Scene:
    """The room loaded once; scenes are immutable. A scene keeps what was built of it for each kind of film, and every
    kernel has all plugins that are alive: those of other modules are not carried along.
    """
    return tt.load(make_room(), variant=VARIANT)


@pytest.fixture
def weights() -> torch.Tensor:
    """A fixed linear functional of the room's transient (3, 24, 3, 4)."""
    generator = torch.Generator().manual_seed(7)
    return torch.rand((3, 24, 3, 4), generator=generator) - 0.3

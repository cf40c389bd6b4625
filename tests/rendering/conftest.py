"""Fixtures around the small room."""

from __future__ import annotations

import pytest
import torch


@pytest.fixture
def weights() -> torch.Tensor:
    """A fixed linear functional of the room's transient (3, 24, 3, 4)."""
    generator = torch.Generator().manual_seed(7)
    return torch.rand((3, 24, 3, 4), generator=generator) - 0.3

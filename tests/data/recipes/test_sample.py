"""Arrays of samples: in C order, whatever order films have."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchtransient.data.sample import in_order

# Of films, from pixels first to pixels last: histograms in one and three channels, phasors, of several cameras, Stokes
# components, an exhaustive scan, a steady image.
FILMS = {
    "mono": ((16, 24, 128, 1), (3, 2, 0, 1), torch.float32),
    "colour": ((16, 24, 64, 3), (3, 2, 0, 1), torch.float32),
    "phasor": ((16, 24, 128, 1), (3, 2, 0, 1), torch.complex64),
    "cameras": ((4, 16, 24, 64, 3), (0, 4, 3, 1, 2), torch.float32),
    "exhaustive": ((8, 9, 5, 7, 16, 1), (5, 4, 2, 3, 0, 1), torch.float32),
    "steady": ((160, 120, 3), (2, 0, 1), torch.float32),
    "small": ((4, 4, 8, 1), (3, 2, 0, 1), torch.float32),
    "columns first": ((24, 16, 128, 1), (3, 2, 1, 0), torch.float32),
    "as they are": ((1, 128, 16, 24), (0, 1, 2, 3), torch.float32),
    "flat": ((2**16,), (0,), torch.float32),
}


@pytest.mark.parametrize("name", FILMS)
def test_arrays_are_turned_as_they_are(name):
    shape, order, dtype = FILMS[name]
    tensor = torch.randn(shape, generator=torch.Generator().manual_seed(1), dtype=dtype).permute(order)
    found = in_order(tensor)
    assert found.flags.c_contiguous and found.shape == tuple(tensor.shape)
    np.testing.assert_array_equal(found, tensor.contiguous().numpy())

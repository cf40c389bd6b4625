"""Metres of optical path and seconds."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchtransient.errors import UnitError
from torchtransient.units import SPEED_OF_LIGHT, opl_to_seconds, seconds_to_opl


def test_the_definition_of_the_metre():
    assert SPEED_OF_LIGHT == 299792458.0
    assert seconds_to_opl(1.0) == 299792458.0
    assert opl_to_seconds(299792458.0) == 1.0


@pytest.mark.parametrize("value", [2.5, np.array([0.1, 3.0]), torch.tensor([[0.1, 3.0]]), torch.tensor(7.0).double()])
def test_there_and_back_keeps_type_and_dtype(value):
    back = seconds_to_opl(opl_to_seconds(value))
    assert type(back) is type(value)
    assert getattr(back, "dtype", None) == getattr(value, "dtype", None)
    np.testing.assert_allclose(np.asarray(back), np.asarray(value), rtol=2e-7)


def test_gradient_passes():
    opl = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
    opl_to_seconds(opl).backward()
    assert opl.grad.item() == 1 / SPEED_OF_LIGHT


@pytest.mark.parametrize(
    "value", [torch.ones(2, dtype=torch.float16), torch.ones(2).bfloat16(), np.ones(2, np.float16)]
)
@pytest.mark.parametrize("convert", [opl_to_seconds, seconds_to_opl])
def test_half_precision_is_refused(convert, value):
    with pytest.raises(UnitError, match="float32 or float64"):
        convert(value)

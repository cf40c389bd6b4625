"""Noise of counts out of a fixed number of cycles."""

from __future__ import annotations

import torch

from torchtransient.sensing.spad import spad


def test_covariance_is_that_of_multinomial_counts(monkeypatch):
    """trials (diag p - p p^T), from what becomes of each normal number by itself: the noise is linear in them."""
    trials, p = 50, torch.tensor([0.1, 0.25, 0.05, 0.3], dtype=torch.float64)
    columns = []
    for normal in torch.eye(5, dtype=torch.float64):
        numbers = iter(normal.split((4, 1)))
        monkeypatch.setattr(spad, "gaussian_noise", lambda var, _, of=numbers: var.sqrt() * next(of).view(-1, 1, 1))
        columns.append(spad.multinomial_noise(p.view(4, 1, 1), trials).flatten())
    found = torch.stack(columns, 1) @ torch.stack(columns)
    torch.testing.assert_close(found, trials * (torch.diag(p) - torch.outer(p, p)), rtol=1e-12, atol=1e-12)

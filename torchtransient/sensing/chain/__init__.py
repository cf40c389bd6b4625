"""Sensors in a row: their order, whether they fit, one walk for means and draws."""

"""Devices as data, and those that have a name."""

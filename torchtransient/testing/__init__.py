"""Helpers for testing renderers and gradients: closed forms, finite differences, statistics.

Numpy only, but for captures, which are tensors.
"""

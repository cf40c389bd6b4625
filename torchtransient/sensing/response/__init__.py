"""Instrument responses along time: their shapes, their composition, the modules that apply them."""

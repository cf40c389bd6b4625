"""Scenes of the layer: loaded, described, checked, edited, built, planned and saved."""

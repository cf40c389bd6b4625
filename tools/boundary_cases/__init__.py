"""Scenes in which edges move, and the parts of their derivatives."""

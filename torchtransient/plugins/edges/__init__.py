"""Edges and limbs of a scene: where one thing may begin to hide another."""

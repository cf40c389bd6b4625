"""Flips, turns, crops and affine maps of samples: of light and labels alike; and filters of images in each bin."""

"""Pixels of several SPADs, and the histograms that a pixel can afford."""

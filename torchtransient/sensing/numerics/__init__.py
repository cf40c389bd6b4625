"""Draws of many counts, convolutions, sums and linear solvers: what several detectors compute with."""

"""Correlated noise: afterpulsing on counts and in the detector, optical crosstalk."""

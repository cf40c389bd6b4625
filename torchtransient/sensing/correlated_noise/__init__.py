"""Detections that others caused: afterpulses and crosstalk."""

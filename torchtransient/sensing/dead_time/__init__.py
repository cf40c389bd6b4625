"""The arithmetic of dead time: cycles of several detections, detectors that run free, their stationary state."""

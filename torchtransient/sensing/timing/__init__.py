"""What moves time stamps: jitter of detections and sweeps, late pixels, converters."""

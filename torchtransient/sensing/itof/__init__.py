"""Indirect time of flight: codes, correlation, pixels of two taps, and depth read from them."""

"""Randomised scenes: what may vary, what a sample is made of, and how it is made."""

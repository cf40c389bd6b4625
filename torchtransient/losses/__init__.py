"""Losses and likelihoods that match the noise of the sensors. Torch only, never Mitsuba."""

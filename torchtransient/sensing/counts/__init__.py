"""Counts as they are drawn: shot noise, counts that others caused, counts that move in time."""

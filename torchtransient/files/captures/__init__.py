"""Captures of other programs on disk, a file for each layout."""

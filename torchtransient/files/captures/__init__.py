"""Captures of this and of other programs on disk, a file for each layout."""

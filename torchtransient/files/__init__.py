"""Renders, captures and volumes on disk, and what files of this library share."""

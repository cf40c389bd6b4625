"""Data sets as torch reads them: by index, as a stream, in windows of time and parts of the image."""

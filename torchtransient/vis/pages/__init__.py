"""Pages that show results in a browser: what is on them, how it is quantised, and the server for large files."""

"""Pages that show results in a browser: what is on them, how it is quantised, and the server for large files.

A page is bokeh's, driven by one script (``view.js``): a standalone file with 1.7 MB of scripts (plotly: 4.5 MB; panel
and ipywidgets need a server or a kernel). The cube is gzipped codes of 8 bits that the browser unpacks, a picture is a
table over codes: 44 to 60 frames a second for 256 x 256 pixels without a GPU on two busy cores. ``content.py``,
``layout.py`` and ``server.py`` import no torch: the server of a large file has its address after 0.8 s of CPU time,
1.9 s with torch.
"""

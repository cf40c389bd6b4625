"""Settings of Sphinx for the site; `make docs` runs them through `docs/site/build.py`, which lays the sources out."""

from __future__ import annotations

import os
import sys
from pathlib import Path

SOURCE = Path(os.environ["TORCHTRANSIENT_SITE"])  # where build.py has laid the pages out
sys.path.insert(0, str(Path(__file__).parent))

import torchtransient  # noqa: E402  before Dr.Jit

from docstrings import as_restructured  # noqa: E402  isort: skip

project, author, copyright = "torchtransient", "the torchtransient authors", "the torchtransient authors"
version = release = torchtransient.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx_gallery.gen_gallery",
]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = ["training_examples/*", "docs/site/*"]
nitpicky = True
# Types of others, which this site does not hold, and short names in annotations.
nitpick_ignore_regex = [("py:.*", ".*")]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
suppress_warnings = ["myst.header", "config.cache"]

default_role = "literal"
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_default_options = {"members": True, "show-inheritance": False}
autosummary_generate = False
napoleon_numpy_docstring = False
napoleon_use_rtype = False

sphinx_gallery_conf = {
    "examples_dirs": [str(SOURCE / "training_examples")],
    "gallery_dirs": ["gallery"],
    "plot_gallery": False,  # they take minutes, and print what docs/examples.md shows
    "ignore_pattern": r"GALLERY_HEADER|^$",
    "within_subsection_order": "FileNameSortKey",
    "download_all_examples": False,
    "show_signature": False,
    "min_reported_time": 1e9,
    "remove_config_comments": True,
}

html_theme = "furo"
html_title = "torchtransient"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_show_sphinx = False
html_copy_source = False


def setup(app):  # type: ignore[no-untyped-def]
    # Before napoleon, which takes "Args:", "Returns:" and "Raises:" apart.
    app.connect("autodoc-process-docstring", as_restructured, priority=400)

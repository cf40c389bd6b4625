"""Numbers in YAML as everybody writes them: PyYAML, after YAML 1.1, takes 1e-10 for a text, since it has no point."""

from __future__ import annotations

import re
from typing import Any

_WITHOUT_POINT = re.compile(r"[-+]?[0-9]+[eE][-+]?[0-9]+")


def reads_exponents(loader: Any) -> Any:
    """A class of PyYAML's loaders, changed so that plain 1e-10 is a number, as in JSON and YAML 1.2; a quoted one stays
    a text.
    """
    loader.add_implicit_resolver("tag:yaml.org,2002:float", _WITHOUT_POINT, list("-+0123456789"))
    return loader

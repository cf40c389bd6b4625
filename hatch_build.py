"""README.md as the description of the package on an index, where relative links lead nowhere.

With an address of the sources, `Source` of [project.urls] in pyproject.toml, links and pictures lead there, in the
layout of GitHub. Without one, links are their text, and pictures are left out with the line under them.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

_ELSEWHERE = r"(?!https?://|mailto:|#)"
_PICTURE = re.compile(rf"!\[(?P<text>[^\]]*)\]\({_ELSEWHERE}(?P<to>[^)]+)\)")
_CAPTIONED = re.compile(rf"{_PICTURE.pattern}\n\n(?:\*[^*\n]+\*\n\n)?")
_LINK = re.compile(rf"(?<!!)\[(?P<text>[^\]]*)\]\({_ELSEWHERE}(?P<to>[^)]+)\)")
_WHERE_PAGES_ARE = "\nThe pages that are named here, `docs/` and others, come with the sources.\n"


def long_description(readme: str, repository: str) -> str:
    """``readme`` without relative links. ``repository``: where its files are, "" for nowhere."""
    if not repository:
        return _LINK.sub(r"\g<text>", _CAPTIONED.sub("", readme)).rstrip() + "\n" + _WHERE_PAGES_ARE
    base = f"{repository.rstrip('/')}/blob/HEAD"
    readme = _PICTURE.sub(rf"![\g<text>]({base}/\g<to>?raw=true)", readme)
    return _LINK.sub(rf"[\g<text>]({base}/\g<to>)", readme)


class LongDescription(MetadataHookInterface):
    """What hatchling asks for the `readme` that pyproject.toml calls dynamic."""

    PLUGIN_NAME = "custom"

    def update(self, metadata: dict[str, Any]) -> None:
        repository = metadata.get("urls", {}).get("Source", "")
        text = long_description((Path(self.root) / "README.md").read_text(encoding="utf-8"), repository)
        metadata["readme"] = {"content-type": "text/markdown", "text": text}

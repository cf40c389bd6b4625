"""YAML of anyone as plain data: nothing is executed, nothing is expanded, texts are bounded.

What another program's tags would make of a node (``!!python/object``, arrays of numpy) is left as it stands there: the
mapping, list or text under the tag.
"""

from __future__ import annotations

from typing import Any

from torchtransient.array_files.plain_texts import safe_loader, yaml_data
from torchtransient.errors import MissingPackageError, StorageError

# Ground truth of 1024 x 1024 points with normals takes 43 MB as text.
MOST_CHARACTERS = 2**27
MOST_NODES = 2**16
MOST_LEVELS = 100


def read_plain_yaml(text: str, what: str) -> Any:
    """The data of a YAML text. Raises StorageError for what is no YAML, for more than 2^16 nodes once aliases are
    written out, for more than 100 levels, and for a missing PyYAML.
    """
    yaml = _package(what)
    if len(text) > MOST_CHARACTERS:
        raise StorageError(f"{what}: expected a YAML text below {MOST_CHARACTERS:,} characters, got {len(text):,}.")
    return yaml_data(text, what, yaml, _loader(yaml), MOST_NODES)


def write_plain_yaml(data: Any, what: str) -> str:
    """Plain data as YAML text that y-tal's own loader reads as well."""
    text: str = _package(what).safe_dump(data, sort_keys=False, allow_unicode=True)
    return text


def _loader(yaml: Any) -> Any:
    class Loader(safe_loader(yaml)):  # type: ignore[misc]  # the package has no types
        """Plain data only."""

    def plain(loader: Any, _suffix: str, node: Any) -> Any:
        if isinstance(node, yaml.MappingNode):
            return loader.construct_mapping(node, deep=True)
        if isinstance(node, yaml.SequenceNode):
            return loader.construct_sequence(node, deep=True)
        return loader.construct_scalar(node)

    for tag in ("timestamp", "binary"):  # JSON has neither dates nor bytes
        Loader.add_constructor(f"tag:yaml.org,2002:{tag}", lambda loader, node: plain(loader, "", node))
    for tag in ("set", "omap", "pairs"):
        Loader.add_constructor(f"tag:yaml.org,2002:{tag}", lambda loader, node: plain(loader, "", node))
    Loader.add_multi_constructor("", plain)
    return Loader


def _package(what: str) -> Any:
    try:
        import yaml
    except ImportError as error:
        raise MissingPackageError(
            f"{what}: YAML needs PyYAML. Install it with pip install 'torchtransient[yaml]'."
        ) from error
    return yaml

"""YAML of anyone as plain data: nothing is executed, nothing is expanded, texts are bounded.

What another program's tags would make of a node (``!!python/object``, arrays of numpy) is left as it stands there: the
mapping, list or text under the tag.
"""

from __future__ import annotations

from typing import Any

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
    try:
        _check_events(yaml, text, what)
        return yaml.load(text, Loader=_loader(yaml))
    except (yaml.YAMLError, ValueError, TypeError, OverflowError, RecursionError, AttributeError) as error:
        if isinstance(error, StorageError):
            raise
        raise StorageError(f"{what}: expected plain YAML, got what cannot be read: {error}.") from None


def write_plain_yaml(data: Any, what: str) -> str:
    """Plain data as YAML text that y-tal's own loader reads as well."""
    text: str = _package(what).safe_dump(data, sort_keys=False, allow_unicode=True)
    return text


def _check_events(yaml: Any, text: str, what: str) -> None:
    """Count nodes as aliases repeat them, and levels, before anything is built."""
    sizes: list[int] = [0]
    anchors: dict[str, int] = {}
    names: list[str | None] = [None]
    for event in yaml.parse(text, Loader=_base(yaml)):
        if isinstance(event, yaml.AliasEvent):
            sizes[-1] += anchors.get(event.anchor, 1)
        elif isinstance(event, yaml.ScalarEvent):
            sizes[-1] += 1
            if event.anchor is not None:
                anchors[event.anchor] = 1
        elif isinstance(event, yaml.CollectionStartEvent):
            sizes.append(1)
            names.append(event.anchor)
        elif isinstance(event, yaml.CollectionEndEvent):
            size, name = sizes.pop(), names.pop()
            sizes[-1] += size
            if name is not None:
                anchors[name] = size
        if len(sizes) > MOST_LEVELS or sizes[-1] > MOST_NODES:
            raise StorageError(f"{what}: expected YAML of at most {MOST_NODES:,} nodes and {MOST_LEVELS} levels.")


def _loader(yaml: Any) -> Any:
    class Loader(_base(yaml)):  # type: ignore[misc]  # the package has no types
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


def _base(yaml: Any) -> Any:
    return getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def _package(what: str) -> Any:
    try:
        import yaml
    except ImportError as error:
        raise MissingPackageError(
            f"{what}: YAML needs PyYAML. Install it with pip install 'torchtransient[yaml]'."
        ) from error
    return yaml

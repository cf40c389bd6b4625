"""YAML and JSON texts of any origin as plain data.

Nothing is executed, and aliases expand to no more nodes than the text has characters. Every failure is a StorageError
of one line.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from torchtransient.checks import check_special, path_of, short_message
from torchtransient.errors import MissingPackageError, StorageError, TorchTransientError

MOST_LEVELS = 100
# Most nodes of a text with fewer characters, once aliases are expanded.
_NODES = 2**16
# Ground truth of 1024 x 1024 points with normals takes 43 MB as text.
_CHARACTERS = 2**27
_WITHOUT_POINT = re.compile(r"[-+]?[0-9]+[eE][-+]?[0-9]+")
# Errors of PyYAML's constructors and Python's parsers for texts in another format.
_WRONG = (ValueError, TypeError, LookupError, ArithmeticError, AttributeError, RecursionError, MemoryError)


def text_of_file(path: Any, what: str) -> str:
    """Return the text of a file in UTF-8.

    Args:
        path: path of the file.
        what: subject of messages.

    Raises:
        StorageError: for missing and unreadable files, and for devices and pipes, which may have no end.
    """
    check_special(path_of(path, what), what)
    try:
        return Path(path).read_text(encoding="utf-8")
    except (OSError, ValueError, TypeError) as error:
        reason = short_message(error)
        raise StorageError(f"{what}: expected a text, but '{str(path)[:200]}' cannot be read: {reason}.") from error


def json_data(text: str | bytes, what: str) -> Any:
    """Return the data of a JSON text.

    Args:
        text: the text.
        what: subject of messages.

    Raises:
        StorageError: for other texts.
    """
    try:
        return json.loads(text)
    except _WRONG as error:
        raise StorageError(f"{what}: expected JSON, got what cannot be read: {short_message(error)}.") from error


def yaml_data(text: str, what: str, yaml: Any, loader: Any = None, most_nodes: int | None = None) -> Any:
    """Return the data of a YAML text, with 1e-10 as a number.

    Args:
        text: the text.
        what: subject of messages.
        yaml: the package PyYAML.
        loader: one of its safe loaders, None for :func:`safe_loader`.
        most_nodes: most nodes with aliases expanded; by default the number of characters, 65536 at least.

    Raises:
        StorageError: for texts in another format, more than 100 levels and more than ``most_nodes`` nodes.
        TorchTransientError: errors that constructors of ``loader`` raise.
    """
    own: Any = type("Loader", (loader or safe_loader(yaml),), {})
    # PyYAML follows YAML 1.1, where a number needs a point. A quoted 1e-10 stays a text.
    own.add_implicit_resolver("tag:yaml.org,2002:float", _WITHOUT_POINT, list("-+0123456789"))
    try:
        _check_events(yaml, text, what, most_nodes or max(_NODES, len(text)))
        return yaml.load(text, Loader=own)
    except TorchTransientError:
        raise
    except (yaml.YAMLError, *_WRONG) as error:
        raise StorageError(f"{what}: expected YAML, got what cannot be read: {short_message(error)}.") from error


def read_plain_yaml(text: str, what: str) -> Any:
    """Return the data of a YAML text with any tags, which are left out.

    Args:
        text: the text.
        what: subject of messages.

    Returns:
        Mappings, lists, texts and numbers as they stand under tags such as ``!!python/object``; nothing is executed.

    Raises:
        StorageError: for texts in another format, of more than 2^27 characters, more than 2^16 nodes with aliases
            expanded, or more than 100 levels.
        MissingPackageError: without PyYAML.
    """
    yaml = yaml_package(what)
    if len(text) > _CHARACTERS:
        raise StorageError(f"{what}: expected a YAML text below {_CHARACTERS:,} characters, got {len(text):,}.")
    return yaml_data(text, what, yaml, _lenient_loader(yaml), _NODES)


def write_plain_yaml(data: Any, what: str) -> str:
    """Return plain data as YAML text that y-tal's loader reads as well.

    Args:
        data: mappings, lists, texts and numbers.
        what: subject of messages.

    Raises:
        MissingPackageError: without PyYAML.
    """
    text: str = yaml_package(what).safe_dump(data, sort_keys=False, allow_unicode=True)
    return text


def _lenient_loader(yaml: Any) -> Any:
    """Return a loader that reads all tags as the plain data under them."""

    class Loader(safe_loader(yaml)):  # type: ignore[misc]  # the package has no types
        """Plain data only."""

    def plain(loader: Any, _suffix: str, node: Any) -> Any:
        if isinstance(node, yaml.MappingNode):
            return loader.construct_mapping(node, deep=True)
        if isinstance(node, yaml.SequenceNode):
            return loader.construct_sequence(node, deep=True)
        return loader.construct_scalar(node)

    for tag in ("timestamp", "binary", "set", "omap", "pairs"):  # JSON has none of these
        Loader.add_constructor(f"tag:yaml.org,2002:{tag}", lambda loader, node: plain(loader, "", node))
    Loader.add_multi_constructor("", plain)
    return Loader


def yaml_package(what: str) -> Any:
    """Return the module yaml.

    Args:
        what: subject of messages.

    Raises:
        MissingPackageError: if PyYAML is not installed.
    """
    try:
        import yaml
    except ImportError as error:
        raise MissingPackageError(
            f"{what}: YAML needs PyYAML. Install it with pip install 'torchtransient[yaml]'."
        ) from error
    return yaml


def safe_loader(yaml: Any) -> Any:
    """Return the loader of PyYAML that makes plain data only, the one in C if it is installed.

    Args:
        yaml: the package PyYAML.
    """
    return getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def _check_events(yaml: Any, text: str, what: str, most: int) -> None:
    """Raise StorageError for too many nodes, aliases expanded, or levels, before anything is built."""
    sizes: list[int] = [0]
    anchors: dict[str, int] = {}
    names: list[str | None] = [None]
    for event in yaml.parse(text, Loader=safe_loader(yaml)):
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
        if len(sizes) > MOST_LEVELS or sizes[-1] > most:
            raise StorageError(f"{what}: expected YAML of at most {most:,} nodes and {MOST_LEVELS} levels, got more.")

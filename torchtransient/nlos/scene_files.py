"""The files that a complete scene is made of."""

from __future__ import annotations

from pathlib import Path

from torchtransient.errors import SceneError
from torchtransient.files.content_key import contents_of
from torchtransient.scene.load import Scene
from torchtransient.scene.objects import LoadedScene
from torchtransient.scene.variant import active_variant


def files_of(scene: Scene) -> dict[str, str]:
    """What is in the files that a scene names anywhere, by the name that it has there: included files, defaults and
    values of ``$parameters`` count. Raises SceneError for a description that Mitsuba cannot read.
    """
    import mitsuba as mi

    description, found = scene._description, {}
    description.check_described("tt.nlos: a simulation that is kept in files")
    assert not isinstance(description, LoadedScene)  # refused above
    with active_variant(scene.variant), description.resolved_files():
        try:
            nodes = description.parse(mi.parser.ParserConfig(scene.variant)).nodes
        except RuntimeError as error:
            raise SceneError(f"{description.name}: {error}") from error
        for props in (node.props for node in nodes):
            for name in list(props):
                if props.type(name) == mi.Properties.Type.String:
                    value = str(props[name])
                    found[value] = contents_of(Path(str(mi.file_resolver().resolve(value))))
    return {name: contents for name, contents in found.items() if contents}

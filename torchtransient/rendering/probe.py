"""What a scene of strangers does, tried in a process of its own: ``tt.load(..., trusted=False)``."""

from __future__ import annotations

import json
import os
import pickle
import signal
import subprocess
import sys
from typing import TYPE_CHECKING, Any

from torchtransient.errors import SceneError, TorchTransientError
from torchtransient.plugins import kind_of
from torchtransient.rendering.nodes import children, is_film

if TYPE_CHECKING:
    from torchtransient.rendering.scene_handle import Scene

# So long may a scene take to be loaded, compiled and rendered a few pixels of; the start of the process is included.
SECONDS = 120.0
# Rows and columns that are rendered of a film, around its middle.
PIXELS = 4
_SAID = "torchtransient probe: "
# A module that is run is not the one that is imported: the child calls it by its name.
_CHILD = "import torchtransient.rendering.probe as probe; probe.child()"


def probe(scene: Scene, seconds: float | None = None) -> None:
    """Build ``scene`` and render a few pixels of each of its sensors in a process of its own.

    Raises ``SceneError`` for what is found wrong there, for a process that is ended by a signal, which is named, and
    for one that takes more than ``seconds`` (None: 120 s).
    """
    limit = SECONDS if seconds is None else seconds
    scene._description.check_described("tt.load(..., trusted=False)")
    name = scene._description.name
    others = [(entry.module, entry.plugins) for entry in _modules_of_others()]
    sent = pickle.dumps((scene, scene.variant, others))
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)}
    process = subprocess.Popen(
        [sys.executable, "-c", _CHILD], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        env=environment, start_new_session=True,
    )  # fmt: skip
    try:
        out, _ = process.communicate(sent, timeout=limit)
    except subprocess.TimeoutExpired:
        raise SceneError(
            f"{name}: expected a scene that is loaded and rendered, a few pixels of it, within {limit:g} s, got no "
            "answer in a process of its own. It was not loaded here."
        ) from None
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()
    if process.returncode < 0:
        raise SceneError(
            f"{name}: expected a scene that can be rendered, got {_signal(-process.returncode)}, which ended the "
            "process in which it was tried. It was not loaded here; a file of it is damaged, or made to do this."
        )
    said = [line for line in out.decode("utf-8", "replace").splitlines() if line.startswith(_SAID)]
    if not said:
        raise SceneError(f"{name}: the process in which the scene was tried ended with code {process.returncode}.")
    error = json.loads(said[-1].removeprefix(_SAID))
    if error is not None:
        raise SceneError(error)


def _modules_of_others() -> Any:
    from torchtransient.plugins._registry import modules_of_others

    return modules_of_others()


def _signal(number: int) -> str:
    try:
        return f"the signal {signal.Signals(number).name}"
    except ValueError:
        return f"the signal {number}"


def child() -> None:
    """What the process of its own does: one line on what it found, as JSON, null for nothing wrong."""
    from torchtransient.plugins import register_module

    error: str | None = None
    try:
        scene, variant, others = pickle.load(sys.stdin.buffer)
        for module, registered in others:
            register_module(module, registered)
        _render(scene, variant)
    except TorchTransientError as raised:
        error = str(raised)
    except Exception as raised:  # noqa: BLE001  whatever comes is what is looked for
        text = " ".join(str(raised).split())[:400]
        error = f"the scene cannot be rendered, {type(raised).__name__}: {text}"
    sys.stdout.write(f"\n{_SAID}{json.dumps(error)}\n")
    sys.stdout.flush()
    os._exit(0)


def _render(scene: Scene, variant: str) -> None:
    import drjit as dr
    import mitsuba as mi

    from torchtransient.rendering.build import build
    from torchtransient.rendering.build_options import BuildOptions
    from torchtransient.rendering.kernel_errors import named_errors
    from torchtransient.rendering.variant import active_variant

    with active_variant(variant), named_errors():
        built = build(_Cropped(scene._description), variant, BuildOptions()).scene  # type: ignore[arg-type]
        if not built.sensors():
            raise SceneError(f"{scene!r} has no sensor; add one.")
        for number in range(len(built.sensors())):
            dr.eval(mi.render(built, sensor=number, spp=1, seed=0))
        dr.sync_thread()


class _Cropped:
    """A description whose films are a few pixels of what they are."""

    def __init__(self, description: Any):
        self._description = description

    def __getattr__(self, name: str) -> Any:
        return getattr(self._description, name)

    def parse(self, config: Any) -> Any:
        """Mitsuba's parser state, with smaller films where a sensor does not give each pixel a place of its own."""
        state = self._description.parse(config)
        by_id = state.id_to_index
        for node in state.nodes:
            below = [state.nodes[index] for _, index in children(state, node, by_id)]
            if kind_of(node.props.plugin_name()) != "sensor":
                for film in below:
                    if is_film(film):
                        _crop(film.props)
        return state


def _crop(props: Any) -> None:
    if props.get("exhaustive_scan", False) is not False:
        return
    for side, along in (("width", "x"), ("height", "y")):
        whole = props.get(side, 768 if side == "width" else 576)
        there, first = props.get(f"crop_{side}", whole), props.get(f"crop_offset_{along}", 0)
        numbers = [value for value in (whole, there, first) if isinstance(value, int) and value is not True]
        if len(numbers) == 3 and first >= 0 and PIXELS < there <= whole - first:  # others are refused as they are
            props[side] = whole
            props[f"crop_{side}"], props[f"crop_offset_{along}"] = PIXELS, first + (there - PIXELS) // 2

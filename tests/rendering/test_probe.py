"""A process of its own in which a scene is tried: what it is sent, what it says, and what becomes of its end."""

from __future__ import annotations

import io
import json
import os
import pickle
import sys
import time
from types import SimpleNamespace

import mitsuba as mi
import pytest

import torchtransient as tt
from tools.small_room import VARIANT, make_room
from torchtransient import plugins
from torchtransient.errors import SceneError
from torchtransient.rendering import probe


class Described:
    """Stands in for a scene."""

    name = "strange.xml"

    def check_described(self, what):
        assert what == "tt.load(..., trusted=False)"


class Scene:
    variant = "llvm_ad_mono"
    _description = Described()


def tried(monkeypatch, code, **settings):
    """With a process that does something else."""
    monkeypatch.setattr(probe, "_CHILD", "import json, os, pickle, sys\n" + code)
    return probe.probe(Scene(), **settings)


def says(value):
    return f"print('{probe._SAID}' + json.dumps({value}))\n"


def test_what_the_process_says(monkeypatch):
    """Its last word counts, among whatever else is printed."""
    assert tried(monkeypatch, "print('hello')\n" + says("'no lobe'") + says("None") + "print('bye')") is None
    with pytest.raises(SceneError, match=r"^no lobe$"):
        tried(monkeypatch, says("None") + says("'no lobe'"))
    with pytest.raises(SceneError, match=r"^strange\.xml: the process in which the scene was tried ended with code 3"):
        tried(monkeypatch, "print('hello'); sys.stdout.flush(); os._exit(3)")
    with pytest.raises(SceneError, match=r"ended with code 0\."):
        tried(monkeypatch, "pass")


@pytest.mark.parametrize(("number", "name"), [(9, "signal SIGKILL"), (11, "signal SIGSEGV")])
def test_signals_by_their_names(monkeypatch, number, name):
    with pytest.raises(SceneError, match=rf"strange\.xml: expected a scene .*, got the {name}, which ended"):
        tried(monkeypatch, says("None") + f"sys.stdout.flush(); os.kill(os.getpid(), {number})")
    assert probe._signal(200) == "the signal 200"


def test_processes_that_give_no_answer_are_ended(monkeypatch, tmp_path):
    begun, mark = time.monotonic(), tmp_path / "pid"
    code = f"open({str(mark)!r}, 'w').write(str(os.getpid())); import time; time.sleep(60)"
    with pytest.raises(SceneError, match=r"strange\.xml: .* within 1\.5 s, got no answer"):
        tried(monkeypatch, code, seconds=1.5)
    assert 1.5 <= time.monotonic() - begun < 30
    if mark.exists():
        with pytest.raises(ProcessLookupError):
            os.kill(int(mark.read_text()), 0)


def test_what_the_process_is_given(monkeypatch):
    """The scene, its variant, the plugins of others, and the places of modules, this one for the empty name."""
    monkeypatch.setattr(probe, "_modules_of_others", lambda: [SimpleNamespace(module="mine", plugins={"a": "bsdf"})])
    monkeypatch.setattr(sys, "path", ["", "/somewhere", *sys.path])
    with pytest.raises(SceneError) as caught:
        tried(monkeypatch, "sys.modules[__name__].Scene = type('Scene', (), {})\n"
              "class Find(pickle.Unpickler):\n"
              "    def find_class(self, module, name): return type(name, (), {})\n"
              "scene, variant, others = Find(sys.stdin.buffer).load()\n"
              "said = [type(scene).__name__, variant, others, os.environ['PYTHONPATH'].split(os.pathsep)[:2]]\n"
              + says("json.dumps(said)"))  # fmt: skip
    assert json.loads(str(caught.value)) == [
        "Scene", "llvm_ad_mono", [["mine", {"a": "bsdf"}]], [os.getcwd(), "/somewhere"]]  # fmt: skip


# ---------------------------------------------------------------------------------------------- inside of the process


def of_child(monkeypatch, capsys, raises=None):
    """What the process says, and what it does."""
    done = []

    def render(scene, variant):
        done.append((scene, variant))
        if raises is not None:
            raise raises

    sent = pickle.dumps(("scene", "a variant", [("mine", {"a": "bsdf"})]))
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO(sent)))
    monkeypatch.setattr(plugins, "register_module", lambda *given: done.append(given))
    monkeypatch.setattr(probe, "_render", render)
    monkeypatch.setattr(os, "_exit", done.append)
    probe.child()
    lines = [line for line in capsys.readouterr().out.splitlines() if line]
    assert done == [("mine", {"a": "bsdf"}), ("scene", "a variant"), 0] and len(lines) == 1
    return json.loads(lines[0].removeprefix(probe._SAID))


@pytest.mark.parametrize(
    ("raised", "said"),
    [
        (None, None),
        (SceneError("no such lobe"), "no such lobe"),
        (ValueError(" no  such\nlobe "), "the scene cannot be rendered, ValueError: no such lobe"),
        (OSError("a" * 401), "the scene cannot be rendered, OSError: " + "a" * 400),
    ],
)
def test_what_the_process_finds(monkeypatch, capsys, raised, said):
    assert of_child(monkeypatch, capsys, raised) == said


def test_what_is_rendered(monkeypatch):
    """One sample of a few pixels of every sensor; none of a sensor is an error."""
    room = make_room()
    room["sensor"]["film"] |= {"width": 300, "height": 200}
    room["other"] = room["sensor"] | {"film": room["sensor"]["film"] | {"width": 3, "height": 200}}
    rendered = []

    def render(scene, sensor, **settings):
        film = scene.sensors()[sensor].film()
        rendered.append((sensor, [int(n) for n in film.size()], [int(n) for n in film.crop_size()],
                         [int(n) for n in film.crop_offset()], settings))  # fmt: skip
        return mi.TensorXf(1.0)

    monkeypatch.setattr(mi, "render", render)
    probe._render(tt.load(room, variant=VARIANT), VARIANT)
    settings = {"spp": 1, "seed": 0}
    by_size = sorted(rendered, key=lambda one: -one[1][0])
    assert sorted(one[0] for one in rendered) == [0, 1]
    assert [one[1:] for one in by_size] == [
        ([300, 200], [4, 4], [148, 98], settings), ([3, 200], [3, 4], [0, 98], settings)]  # fmt: skip
    del room["sensor"], room["other"]
    with pytest.raises(SceneError, match="has no sensor; add one"):
        probe._render(tt.load(room, variant=VARIANT), VARIANT)


def test_pixels_of_scans_stay():
    """Where a sensor gives each pixel a place of its own, and where a film is wrong."""
    room = {"type": "scene", "wall": {"type": "rectangle", "scan": {
        "type": "nlos_capture_meter", "film": {"type": "transient_hdr_film", "width": 32, "height": 16}}},
        "camera": {"type": "perspective", "film": {"type": "hdrfilm", "width": 32, "height": 16}}}  # fmt: skip
    description = tt.load(room, variant=VARIANT)._description
    mi.set_variant(VARIANT)
    plugins.sync()
    state = probe._Cropped(description).parse(mi.parser.ParserConfig(VARIANT))
    films = {node.props.plugin_name(): node.props for node in state.nodes if "film" in node.props.plugin_name()}
    assert "crop_width" not in films["transient_hdr_film"] and films["hdrfilm"]["crop_width"] == 4
    assert probe._Cropped(description).name == description.name

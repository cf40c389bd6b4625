"""What recipes are written as, and what is refused when they are read or made."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchtransient as tt
from torchtransient.data.recipes import places
from torchtransient.data.recipes.distribution import Distribution, _same
from torchtransient.data.recipes.places import _of_text, _placeless
from torchtransient.data.recipes.specification import _counts, _names, is_entry, label_of, samples_of
from torchtransient.data.recipes.written import read, read_distribution, read_frequencies, written
from torchtransient.errors import SceneError, ShapeError

D = tt.data


def test_numbers_of_every_library_are_plain():
    pose = tt.scenes.transforms.translate([1.0, 2.0, 3.0])
    for given, plain in (
        (torch.tensor([1.0, 2.5], requires_grad=True), [1.0, 2.5]), (np.float32(0.5), 0.5), (range(2, 4), [2, 3]),
        ((1, [True, None]), [1, [True, None]]), ({3: np.int64(4)}, {"3": 4}), (np.eye(2), [[1, 0], [0, 1]]),
        (SimpleNamespace(matrix=pose), pose.tolist()),
        (D.Uniform(0, 1), {"uniform": {"low": 0, "high": 1, "same": False}}),
    ):  # fmt: skip
        assert written(given) == plain
    for wrong in (object(), np.array(["a"]), {"a": [object()]}):
        with pytest.raises(SceneError, match="expected numbers, texts, lists, mappings or arrays"):
            written(wrong)


@pytest.mark.parametrize("count", [64, 65])
def test_many_numbers_are_not_listed(count):
    array = np.arange(count, dtype=np.float32) / 3
    plain = written(array)
    assert isinstance(plain, list) == (count == 64)
    assert np.array_equal(np.asarray(read(plain), np.float32), array)
    phase = read(written(np.exp(1j * array)))
    assert np.array_equal(phase, np.exp(1j * array))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (3, "expected a distribution"), ({}, "expected a distribution"),
        ({"uniform": [0, 1], "turn": {}}, "expected a dist"),
        ({"unifrm": 1}, "unknown distribution 'unifrm'. Known ones are uniform"),
        ({"uniform": [0]}, r"uniform: expected \[low, high\] or a mapping of low, high, same, got"),
        ({"uniform": 0}, r"uniform: expected \[low, high\]"), ({"uniform": {"low": 0, "hi": 1}}, "unknown entry 'hi'"),
        ({"uniform": {"low": 0}}, "high.*Its entries are low, high, same"),
    ],
)  # fmt: skip
def test_what_is_no_distribution(given, words):
    with pytest.raises(SceneError, match=f"here: .*{words}"):
        read_distribution("here", given)


def test_distributions_inside_of_others():
    look = read_distribution("x", {"look_at": {"origin": {"uniform": [[0, 0, 1], [0, 0, 2]]}, "target": [0, 0, 0]}})
    assert look == D.LookAt(D.Uniform([0, 0, 1], [0, 0, 2]), [0, 0, 0])
    nodes = read_distribution("x", {"choice": [{"type": "cube"}, {"type": "sphere", "radius": 2}]})
    assert nodes.values == [{"type": "cube"}, {"type": "sphere", "radius": 2}]
    one = D.Turn()
    assert read_distribution("x", one) is one
    assert read_frequencies([0.0, 2.0]) == tt.FrequencyAxis((0.0, 2.0))
    assert read_frequencies({"per_metre": [1.0]}) == tt.FrequencyAxis((1.0,), 0.0)
    assert read_frequencies({"per_metre": [1.0], "start_opl": 3.0}) == tt.FrequencyAxis((1.0,), 3.0)
    assert read_frequencies(None) is None


def test_settings_of_distributions_are_compared_by_their_numbers():
    a, b = {"x": [1, (2, 3)]}, {"x": [1, (2, 3)]}
    assert _same(a, b) and not _same(a, {"x": [1, (2, 4)]}) and not _same(a, {"y": [1, (2, 3)]})
    assert not _same([1], [1, 2]) and _same(np.array([1, 2]), [1, 2]) and not _same(np.array([1, 2]), [1, 3])
    assert not _same({"x": 1}, {"x": 1, "y": 2}) and D.Uniform(0, 1) != D.LogUniform(1, 2)


def test_names_of_distributions():
    with pytest.raises(SceneError, match=r"the name 'uniform' is that of torchtransient.*Uniform"):

        class Other(D.Uniform):
            name = "uniform"

    class Nameless(D.Uniform):
        pass

    with pytest.raises(SceneError, match="Nameless: expected a distribution with a name of its own"):
        written(Nameless(0, 1))

    class WithInit(Distribution):
        name = "with_init_of_its_own"

        def __init__(self, low):
            self.low = low

        def draw(self, random, place):
            return self.low

    try:
        with pytest.raises(SceneError, match="settings are fields: decorate the class"):
            read_distribution("x", WithInit(3))
    finally:
        del Distribution.known["with_init_of_its_own"]


# -------------------------------------------------------------------------------------------------------------- lists


def test_lists_of_names_and_numbers():
    assert _names("labels", ["depth", "uv"]) == ("depth", "uv") and _names("labels", ()) == ()
    for wrong, words in (
        (("depth", "depth"), "expected each once"),
        ("depth", r"write \['depth'\]"),
        ([3], "list of names"),
    ):
        with pytest.raises(SceneError, match=f"recipe: labels: .*{words}"):
            _names("labels", wrong)
    assert [_counts("sensors", given, 0, "all") for given in ("all", 2, [0, 2], 0)] == ["all", 2, (0, 2), 0]
    assert _counts("bounces", np.array([3, 4]), 1, "all") == (3, 4)
    for wrong in (0, [3, 0], 1.5, [None], [], "any"):
        with pytest.raises(SceneError, match="recipe: bounces"):
            _counts("bounces", wrong, 1, "all")
    assert samples_of([0, np.int64(3)]) == [0, 3]
    with pytest.raises(ShapeError, match="at least 0, got -1"):
        samples_of([0, -1, -2])
    with pytest.raises(ShapeError, match="whole numbers of samples"):
        samples_of([0.5])


def test_entries_and_their_labels(tmp_path):
    assert all(is_entry(value) for value in ("a", {"type": "cube"}, True, None)) and not is_entry(1.5)
    nodes = [{"type": "cube"}, {"type": "sphere"}]
    choice = D.Choice(nodes)
    assert label_of(choice, choice.values[1]) == "#1"
    assert label_of(choice, str(tmp_path / "a.ply")) == "a.ply" and label_of(choice, "b/a.ply") == "b/a.ply"
    assert label_of(choice, 2) == "2" and label_of(choice, np.float64(0.5)) == "0.5"
    label = label_of(D.Uniform(0, 1), np.arange(3.0))
    assert len(label) == 13 and label != label_of(D.Uniform(0, 1), np.arange(4.0))


# -------------------------------------------------------------------------------------------------------------- files


def test_places_are_no_part_of_a_recipe(tmp_path):
    """Folders of absolute names and that of a scene; nothing else is cut."""
    inside = {"tree": {"folder": "kept", "a": ["/x/y.ply", "z/y.ply"]}, "folder": "/gone"}
    assert _placeless({"scene": inside, "folder": "kept"}) == {
        "scene": {"tree": {"folder": "kept", "a": ["y.ply", "z/y.ply"]}}, "folder": "kept",
    }  # fmt: skip
    long = "/" + "x" * 1023
    assert _placeless([long, long[:-1], 3]) == [long, long[1:-1], 3]
    plain = {"scene": "/x/y.xml", "vary": ["/x/y.ply"], "device": "/x/y.json"}
    assert places.without_places(plain) == {"scene": "y.xml", "vary": ["y.ply"], "device": "/x/y.json"}
    file = tmp_path / "mesh.ply"
    file.write_text("content")
    (found,) = _of_text("mesh.ply", tmp_path).items()
    assert found[0] == "mesh.ply" and _of_text(str(file), tmp_path) == {"mesh.ply": found[1]}
    assert _of_text("", tmp_path) == _of_text("other.ply", tmp_path) == _of_text("m" * 1024, tmp_path) == {}


def test_files_that_an_xml_scene_names(tmp_path):
    """By its $names, the longest first, and in what it includes, which knows them too."""
    for name in ("cup.ply", "pot.ply", "deep.ply", "own.ply"):
        (tmp_path / name).write_text(name)
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "beside.ply").write_text("beside")
    (tmp_path / "parts" / "more.xml").write_text(
        '<scene><shape filename="$mesh"/><shape filename="beside.ply"/><shape filename="deep.ply"/></scene>'
    )
    (tmp_path / "broken.xml").write_text("<scene>")
    text = (
        '<scene><default name="mesh" value="cup"/><default name="mesh_of_pot" value="pot.ply"/>'
        '<default name="own" value="cup.ply"/><a filename="$mesh_of_pot"/><a filename="$own"/>'
        '<include filename="parts/more.xml"/><include filename="broken.xml"/></scene>'
    )
    found = places._of_xml(text, tmp_path, {"own": "own.ply", "mesh": "cup.ply"}, 3)
    assert set(found) == {
        "pot.ply", "own.ply", "cup.ply", "parts/more.xml", "beside.ply", "deep.ply", "broken.xml",
    }  # fmt: skip
    # One that includes itself comes to the last level.
    (tmp_path / "round.xml").write_text('<scene><include filename="round.xml"/><a filename="cup.ply"/></scene>')
    assert set(places._of_xml('<scene><include filename="round.xml"/></scene>', tmp_path, {}, 3)) == {
        "round.xml", "cup.ply",
    }  # fmt: skip
    # At the last level includes are named and not opened.
    assert set(places._of_xml(text, tmp_path, {}, 0)) == {"pot.ply", "cup.ply", "parts/more.xml", "broken.xml"}
    assert places._of_xml("<scene>", tmp_path, {}, 3) == {}

"""docs/data.md: its blocks run in the order that they stand in, its files and commands are taken, its names exist."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

import torchtransient as tt
from support.pages import Page
from torchtransient.__main__ import main
from torchtransient.rendering.labels import LABELS

VARIANT = "llvm_ad_mono"
PAGE = Page("docs/data.md")
TEXT = PAGE.text
# What makes scenes and data sets small.
SMALLER = {
    r"resolution=32|resolution: 32": lambda found: found[0].replace("32", "8"),
    r"n=2000|n: 2000": lambda found: found[0].replace("2000", "6"),
    r"spp=\d+|spp: \d+": lambda found: re.sub(r"\d+", "4", found[0]),
    r"\(32, 32\), kind|\[32, 32\]": lambda found: found[0].replace("32", "4"),
    r"batch_size=8": lambda _: "batch_size=2",
    r"slice\(0, 16\), slice\(16, 32\)": lambda _: "slice(0, 4), slice(4, 8)",
    r"preview\(12": lambda _: "preview(2",
    r"cost\(\)": lambda _: "cost(1)",
    r"capacity=256|range\(20\)": lambda found: found[0].replace("256", "8").replace("20", "3"),
    r"first=2000": lambda _: "first=6",
    r'"letters", 4': lambda _: '"letters", 2',
    r"num_workers=2": lambda _: "num_workers=1",
    r"Crop\(\(24, 24\)\)": lambda _: "Crop((6, 6))",
}


def smaller(code):
    for large, small in SMALLER.items():
        code = re.sub(large, small, code)
    return code


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """With the files that the page speaks of."""
    place = tmp_path_factory.mktemp("page")
    rooms, letters = PAGE.blocks("yaml")
    (place / "rooms.yaml").write_text(smaller(rooms))
    (place / "letters.yaml").write_text(smaller(letters))
    return place


@pytest.fixture(scope="module")
def names(folder):
    """What stands there after every block has run, in one session from top to bottom."""
    found: dict[str, object] = {"__name__": "__main__"}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for _ in PAGE.run(found, SMALLER):
            pass
    return found


@pytest.mark.slow
def test_a_network_was_trained(names, folder):
    assert np.isfinite(names["loss"].item())
    assert names["light"].shape == (2, 160, 8, 8) and names["depth"].shape == (2, 1, 8, 8)
    found = tt.data.verify(folder / "rooms")
    assert found.complete and found.samples == 6 and not found.failed


@pytest.mark.slow
def test_the_file_is_the_recipe(names):
    recipe, same = names["recipe"], names["same"]
    for index in range(2):
        one, other = recipe.sample(index), same.sample(index)
        assert all(np.array_equal(one.arrays[name], other.arrays[name], equal_nan=True) for name in one.arrays)
        assert all(np.array_equal(one.values[key], other.values[key]) for key in one.values)
    assert same.n == recipe.n and same.vary["small-box.to_world"] == recipe.vary["small-box.to_world"]
    # A drawn pose is what the data set says that it was.
    stored = next(item for item in names["rooms"] if item["index"] == 0)
    assert np.allclose(stored["values"]["large-box.to_world"], recipe.draw(0)["large-box.to_world"])


@pytest.mark.slow
def test_recipes_are_written_and_read(names, folder):
    assert tt.data.Recipe.read(folder / "written.yaml") == names["recipe"]
    letters = tt.data.Recipe.read(folder / "letters.yaml")
    letters.check()
    # That of the page's scan, which the smaller one needs less of.
    wide = tt.nlos.Scan.grid(names["wall"], 32, kind="confocal").default_axis(names["stays_in"], 0.02)
    assert letters.settings.time_axis == wide


@pytest.mark.slow
def test_costs_and_pictures(names, folder):
    shown = re.search(r"```text\n(.*?)```", TEXT, flags=re.DOTALL)[1]
    # The same lines, with other numbers.
    pages, here = ([line[:18] for line in text.splitlines()] for text in (shown, str(names["cost"])))
    assert pages[:-1] == here[:-1] and pages[-1].startswith("2000 samples ") and here[-1].startswith("6 samples ")
    assert (folder / "rooms.png").stat().st_size > 5000


@pytest.mark.slow
def test_commands(names, folder, monkeypatch):
    """The data set of the first block is the one that the first command goes on with."""
    monkeypatch.chdir(folder)
    tt.data.generate(names["same"], "named", progress=False)
    for line in (line.split("#")[0].split() for block in PAGE.blocks("sh") for line in block.splitlines()):
        assert line[:2] == ["torchtransient", "dataset"]
        words = [word.replace("$SLURM_ARRAY_TASK_ID", "3").replace("/shared/rooms", "array") for word in line[1:]]
        words = ["named" if word == "rooms" else word for word in words]
        if "ray" in words:
            words = [{"ray": "local", "64": "2"}.get(word, word) for word in words]
            at = words.index("--address")
            del words[at : at + 2]
        result = CliRunner().invoke(main, words)
        assert result.exit_code == 0, result.output
    assert (folder / "named" / "samples.png").stat().st_size > 5000
    assert tt.data.verify("array").complete
    for said in re.findall(r"`torchtransient dataset (\w+) ", TEXT):
        assert CliRunner().invoke(main, ["dataset", said, "--help"]).exit_code == 0


@pytest.mark.slow
def test_files_of_a_folder(names, folder):
    table = TEXT.split("## What the folder holds")[1].split("A shard is")[0]
    rows = set(re.findall(r"^\| `([\w.-]+)`[,| ]", table, re.M))
    there = {path.name for path in (folder / "rooms").iterdir()}
    assert rows == {name for name in there if not name.startswith("shard-") or name == "shard-000000.h5"}
    described = json.loads((folder / "rooms" / "recipe.json").read_text())
    assert {"recipe", "key", "n", "per_shard", "store", "compression", "about"} <= set(described)


@pytest.mark.slow
def test_the_table_of_a_shard_is_a_shard(names, folder):
    """Every data set that a file has is in the table, as the table says."""
    import h5py

    path = folder / "rooms" / "shard-000000.h5"
    table = TEXT.split("A shard is HDF5")[1].split("Chunks hold")[0]
    kinds = dict(re.findall(r"^\| `([\w/]+)` \| `?\(?.*?\)?`? (\w+) \|", table, re.M))
    found = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.update({name: item.dtype}) if isinstance(item, h5py.Dataset) else None)
        about = json.loads(file["about"][()].tobytes())
    for name in ("index", "seed", "outside", "there", "arrays/transient", "arrays/steady"):
        assert kinds[name] == str(found[name]), name
    rest = set(found) - set(kinds) - {"about", "arrays/depth"}
    assert all(name.startswith("values/") and found[name] == np.float32 for name in rest) and len(rest) == 3
    said = re.search(r"^\| `about` .*", table, re.M)[0]
    assert set(about) == set(re.findall(r"`(\w+)`", said)) - {"about"} and about["format"] in said
    size, seal = int(re.search(r"(\d+) bytes", table)[1]), re.search(r"`(ttshard\d)`", TEXT)[1]
    assert path.read_bytes()[-size:].startswith(seal.encode())


def test_tables_are_those_of_the_code():
    labels = TEXT.split("## Labels")[1].split("## ")[0]
    named = {name for cell in re.findall(r"^\| (`.*?) \|", labels, re.M) for name in re.findall(r"`(\w+)`", cell)}
    assert named == {*LABELS, "first_return"}
    rows = re.findall(r"^\| `(\w+)\([^|]*\| `(\{[^`]*\})`", TEXT.split("## What varies")[1], re.M)
    # Other tests have distributions of their own; two share a row.
    own = [kind for kind in tt.data.Distribution.known.values() if kind.__module__.startswith("torchtransient.")]
    assert len(rows) == len(own) - 1
    for name, written in rows:
        assert issubclass(getattr(tt.data, name), tt.data.Distribution)
        if "..." not in written:
            plain = {"scene": {"builtin": "cornell_box"}, "vary": {"small-box.to_world": yaml.safe_load(written)}}
            recipe = tt.data.Recipe.from_dict(plain | {"variant": VARIANT})
            assert isinstance(recipe.vary["small-box.to_world"], getattr(tt.data, name))
    for name in set(re.findall(r"(?<!utils\.)\bdata\.([A-Za-z]\w+)\(", TEXT)):
        assert hasattr(tt.data, name), name

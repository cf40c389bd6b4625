"""Contract of layouts of captures: what one can hold comes back bit by bit; all else is an error when it is written."""

from __future__ import annotations

import functools
import re
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch

from support.capture_files import (
    ANSWERS,
    AXIS,
    ENDINGS,
    FROM_ZERO,
    ORIGINS,
    SQUARE,
    UP,
    WRITTEN,
    grids,
    holdable,
    listed,
    made,
    read_answered,
    read_only,
    write_content,
    write_mat,
)
from support.pages import Page
from support.sweeps import together
from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.errors import ArgumentError, StorageError
from torchtransient.files import read_capture, write_capture

HOLDABLE = {f"{layout}-{name}": (layout, capture) for layout, name, capture in holdable()}
FOREIGN = [layout for layout in WRITTEN if layout != "torchtransient"]
KINDS = ("single", "confocal", "exhaustive", "pairs")


def test_every_layout_has_files_in_these_tests():
    """Of layouts that are written also captures, whose files come back."""
    held, others = {layout for layout, _ in HOLDABLE.values()}, {layout for layout, _ in read_only()}
    for layout in ENDINGS:
        where = "holdable" if layout in WRITTEN else "read_only"
        assert layout in (held if layout in WRITTEN else others), (
            f"enter small contents of {layout!r} in {where}() of tests/support/capture_files.py"
        )


def test_every_layout_has_its_rows_on_the_page():
    """In the table of what layouts hold, and those that are written in that of what they cannot."""
    page = Page("docs/capture_files.md").text
    for head, layouts in (("| `format` | file |", list(ENDINGS)), ("| `format` | error for |", FOREIGN)):
        rows = page.split(head)[1].split("\n\n")[0].splitlines()[2:]
        found = [re.match(r"\| `(\w+)` \|", row)[1] for row in rows]
        assert sorted(found) == sorted(layouts), f"docs/capture_files.md, {head}: a row for each of {layouts}"


@together("name", list(HOLDABLE))
def test_round_trip(tmp_path, name):
    layout, capture = HOLDABLE[name]
    path = capture.write(tmp_path / f"a{ENDINGS[layout]}", format=layout)
    said = {}
    if layout == "dirac" and capture.scan.first_and_last_leg:
        with pytest.raises(StorageError):  # origins are not stored, and count
            Capture.read(path)
        said = {n: getattr(capture.scan, n).tolist() for n in ("sensor_origin", "laser_origin")}
    back = Capture.read(path, **said)
    assert back.metadata.get("format", layout) == layout
    for kind in ("transient", "phasor", "steady"):
        ours, theirs = getattr(capture, kind), getattr(back, kind)
        assert (ours is None) == (theirs is None)
        assert ours is None or (ours.dtype == theirs.dtype and torch.equal(ours, theirs))
    for setting in ("channels", "polarized", "frequencies"):
        assert getattr(back, setting) == getattr(capture, setting)
    same_scan(capture.scan, back.scan, layout)
    if capture.axis is not None:
        # Seconds, and differences of starts of bins, are rounded once.
        tolerance = 4 * np.spacing(capture.axis.end_opl) if layout in ("rect_data", "dirac") else 0
        assert back.axis.num_bins == capture.axis.num_bins
        assert abs(back.axis.start_opl - capture.axis.start_opl) <= tolerance
        assert abs(back.axis.bin_width_opl - capture.axis.bin_width_opl) <= tolerance
    if layout in ("tal", "torchtransient"):
        assert back == capture and (back.metadata == capture.metadata)


def same_scan(ours, theirs, layout):
    assert (ours.kind, ours.first_and_last_leg) == (theirs.kind, theirs.first_and_last_leg)
    names = ["sensor_points", "laser_points", "sensor_normals", "laser_normals"]
    if layout != "rect_data" and (layout != "dirac" or ours.first_and_last_leg):
        names += ["sensor_origin", "laser_origin"]
    for name in names:
        # Grids of a width and a number of points are computed anew.
        torch.testing.assert_close(
            getattr(ours, name), getattr(theirs, name), rtol=0, atol=1e-15 if layout == "rect_data" else 0
        )


def scans():
    """Scans of every kind with few points, and with one."""
    for legs in (True, False):
        settings = {**ORIGINS, "first_and_last_leg": legs}
        for size in ((1, 1), (1, 3), (2, 2)) if legs else ((2, 2),):
            for kind in KINDS[:3]:
                for spots in ((1, 1), (2, 1)) if kind == "exhaustive" else (None,):
                    if kind != "exhaustive" or size != (1, 1) or spots != (1, 1):
                        yield Scan.grid(SQUARE, size, kind=kind, laser_grid=spots, **settings)
        one = Scan.grid(SQUARE, 1, kind="confocal", **settings)
        yield replace(one, kind="single", laser_points=one.laser_points[0, 0], laser_normals=UP)
        for kind in KINDS:
            whole = listed(kind, legs)
            yield whole
            points = whole.sensor_points[:1]
            spots = {"single": points[0], "confocal": points, "pairs": points}.get(kind, whole.laser_points)
            normals = {"single": UP, "confocal": UP[None], "pairs": UP[None]}.get(kind, whole.laser_normals)
            yield replace(
                whole, sensor_points=points, sensor_normals=UP[None], laser_points=spots, laser_normals=normals
            )


def back(path, layout, capture):
    """Return what is read of a capture that was written; None if it was refused, which leaves nothing behind."""
    try:
        capture.write(path, format=layout)
    except StorageError:
        assert list(path.parent.iterdir()) == []
        return None
    known = {}
    if layout == "dirac" and capture.scan.first_and_last_leg:
        known = {name: getattr(capture.scan, name).tolist() for name in ("sensor_origin", "laser_origin")}
    found = Capture.read(path, layout, **known)
    path.unlink()
    return found


@together("layout", WRITTEN)
def test_kinds_and_shapes(tmp_path, layout):
    held = 0
    for scan in scans():
        capture = made(replace(scan, wall=None), FROM_ZERO)
        found = back(tmp_path / f"a{ENDINGS[layout]}", layout, capture)
        if found is None:
            continue
        held += 1
        ours, theirs = capture.scan, found.scan
        assert (ours.kind, ours.first_and_last_leg) == (theirs.kind, theirs.first_and_last_leg), ours
        if layout == "phasor_field":  # grids become lists
            assert torch.equal(found.transient.reshape(-1), capture.transient.reshape(-1))
        else:
            assert torch.equal(found.transient, capture.transient) and ours.shape == theirs.shape
        if layout != "rect_data":  # which has no place in space
            assert torch.equal(ours.sensor_points.reshape(-1), theirs.sensor_points.reshape(-1))
    assert held > 0


NUMBERS = (
    torch.bool, torch.uint8, torch.int8, torch.int64, torch.uint16, torch.uint64, torch.float16, torch.bfloat16,
    torch.float64,
)  # fmt: skip


@pytest.mark.slow
@together("dtype", NUMBERS)
@together("layout", WRITTEN)
def test_numbers_of_every_kind(tmp_path, layout, dtype):
    """Values come back; types as torch computes with them."""
    kind = "single" if layout == "phasor_field" else "confocal"
    scan = grids(legs=layout != "rect_data", wall=SQUARE, size=(2, 2))[kind]
    values = torch.zeros(1, 7, 2, 2, dtype=torch.float64).to(dtype)
    values[0, 0] = torch.tensor(1.0).to(dtype)
    if dtype not in (torch.bool, torch.uint64):
        limits = torch.finfo(dtype) if dtype.is_floating_point else torch.iinfo(dtype)
        values[0, 1] = torch.tensor(limits.max, dtype=torch.float64 if dtype.is_floating_point else None).to(dtype)
    path = tmp_path / f"a{ENDINGS[layout]}"
    found = back(path, layout, Capture(values, FROM_ZERO, scan))
    if found is None:
        assert dtype in (torch.bool, torch.bfloat16)
    else:
        assert torch.equal(found.transient.double().reshape(-1), values.double().reshape(-1))
    if dtype == torch.uint64:
        huge = torch.from_numpy(np.full(values.shape, 2**63 + 7, np.uint64))
        found = back(path, layout, Capture(huge, FROM_ZERO, scan))
        assert torch.equal(found.transient, huge) if layout == "torchtransient" else found is None


def mirrored(scan, how):
    if how == "hidden side":
        other = {name: -getattr(scan, name) for name in ("sensor_normals", "laser_normals")}
        origins = {n: getattr(scan, n) * torch.tensor([1, 1, -1.0]) for n in ("sensor_origin", "laser_origin")}
        return replace(scan, **other, **origins)
    if how == "hidden side without normals":
        return replace(mirrored(scan, "hidden side"), sensor_normals=None, laser_normals=None)
    ways = {"rows": lambda p: p.flip(0), "columns": lambda p: p.flip(1), "exchanged": lambda p: p.transpose(0, 1)}
    sensor = ways[how](scan.sensor_points).contiguous()
    return replace(scan, sensor_points=sensor, laser_points=sensor if scan.kind == "confocal" else scan.laser_points)


def handed(scan):
    x, y = scan.sensor_points[0, -1] - scan.sensor_points[0, 0], scan.sensor_points[-1, 0] - scan.sensor_points[0, 0]
    side = scan.sensor_origin[2].sign() * UP if scan.sensor_normals is None else scan.sensor_normals[0, 0]
    return float(torch.linalg.cross(x, y) @ side) > 0


@together("how", ["hidden side", "hidden side without normals", "rows", "columns", "exchanged"])
def test_mirror_images_are_not_written(tmp_path, how):
    """The handedness of columns, rows and hidden side is the same in what is read, or it is an error."""
    square = grids(legs=False, wall=SQUARE, size=(4, 4))
    square["single"] = replace(square["single"], laser_points=square["single"].sensor_points[1, 2])
    for layout, kind in (("dirac", "confocal"), ("rect_data", "confocal"), ("rect_data", "single")):
        capture = made(mirrored(square[kind], how), FROM_ZERO)
        found = back(tmp_path / f"a{ENDINGS[layout]}", layout, capture)
        assert found is None or handed(found.scan) == handed(capture.scan)
        assert (found is None) == (layout == "rect_data" or "side" in how or how == "exchanged")
        turned = made(mirrored(mirrored(square[kind], "rows"), "columns"), FROM_ZERO)  # a motion
        found = back(tmp_path / f"a{ENDINGS[layout]}", layout, turned)
        assert found is not None and handed(found.scan) == handed(turned.scan)


@together("layout", FOREIGN)
def test_what_no_foreign_layout_holds(tmp_path, layout):
    path, capture = tmp_path / f"a{ENDINGS[layout]}", made(grids()["confocal"])
    for other in (
        replace(capture, transient=capture.transient.expand(3, -1, -1, -1)),
        replace(capture, transient=capture.transient[None]),
        replace(made(grids()["confocal"], phasor=True), transient=capture.transient, axis=AXIS),
    ):
        with pytest.raises(StorageError):
            other.write(path, format=layout)
    for place in (tmp_path / "a.exr", tmp_path / "no" / path.name):
        with pytest.raises(StorageError):
            capture.write(place, format=layout)
    with pytest.raises(StorageError):
        write_capture(path, capture, {"a": 1}, format=layout)
    assert list(tmp_path.iterdir()) == []


def uneven(way, share=1.2e-3):
    """A square scan that is regular and at right angles to a thousandth but for one way."""
    scan = grids(legs=False, wall=SQUARE, size=(4, 4))["confocal"]
    points = scan.sensor_points.clone()
    if way == "stretched":
        points[..., 1] *= 1 + share
    elif way == "leaning":
        points[..., 0] += share * points[..., 1]
    else:
        points[1, 1, 0] += share * 0.5
    return replace(scan, sensor_points=points, laser_points=points)


LEGS, PLAIN = grids(), grids(legs=False)
REFUSED = [
    ("zaragoza", listed("single"), AXIS), ("zaragoza", PLAIN["confocal"], AXIS),
    ("zaragoza", replace(LEGS["confocal"], sensor_normals=None), AXIS),
    ("phasor_field", LEGS["confocal"], AXIS), ("phasor_field", PLAIN["single"], AXIS),
    ("phasor_field", replace(listed("single"), sensor_normals=None), AXIS),
    ("dirac", LEGS["single"], AXIS), ("dirac", listed("confocal"), AXIS),
    ("dirac", PLAIN["confocal"], TimeAxis(0.0, 0.003, 1)),  # whose start says nothing of its width
    ("dirac", replace(PLAIN["confocal"], sensor_points=PLAIN["confocal"].sensor_points + 0.1,
                      laser_points=PLAIN["confocal"].sensor_points + 0.1), AXIS),
    ("rect_data", LEGS["confocal"], FROM_ZERO), ("rect_data", PLAIN["confocal"], FROM_ZERO),
    ("rect_data", PLAIN["exhaustive"], FROM_ZERO), ("rect_data", PLAIN["confocal"], AXIS),
    ("rect_data", listed("confocal", legs=False), FROM_ZERO),
    *(("rect_data", uneven(way), FROM_ZERO) for way in ("stretched", "leaning", "one point off")),
    ("tal", replace(LEGS["exhaustive"], laser_points=LEGS["exhaustive"].laser_points.reshape(-1, 3),
                    laser_normals=None), AXIS),
]  # fmt: skip


@together("layout, scan, axis", REFUSED)
def test_what_a_layout_cannot_hold(tmp_path, layout, scan, axis):
    assert back(tmp_path / f"a{ENDINGS[layout]}", layout, made(scan, axis)) is None


def test_layouts_that_are_only_read_and_names_of_formats(tmp_path):
    capture = made(LEGS["confocal"])
    for layout in set(ENDINGS) - set(WRITTEN):
        with pytest.raises(StorageError, match="only read"):
            capture.write(tmp_path / f"a{ENDINGS[layout]}", format=layout)
    with pytest.raises(ArgumentError):
        capture.write(tmp_path / "a.h5", "exr")
    with pytest.raises(ArgumentError):
        read_capture(tmp_path / "a.h5", "exr")
    with pytest.raises(StorageError):
        read_capture(tmp_path / "a.h5")


# ------------------------------------------------------------------------------------------- a file has one layout


@functools.cache
def foreign_files():
    files = [(layout, capture) for layout, capture in HOLDABLE.values() if layout != "torchtransient"]
    return [*files, *read_only()]


def foreign_file(folder, number, **more):
    """Layout and path of a small file, with more entries."""
    layout, content = foreign_files()[number]
    path = folder / f"a{ENDINGS[layout]}"
    if isinstance(content, Capture):
        with h5py.File(content.write(path, format=layout), "a") as file:
            file.update(more)
    else:
        write_content(path, content | more if isinstance(content, dict) else [frame | more for frame in content])
    return layout, path


@together("number", range(len(foreign_files())))
def test_no_file_is_read_as_another(tmp_path, number):
    """An axis would be taken for another one."""
    layout, path = foreign_file(tmp_path, number)
    for other in sorted(set(ENDINGS) - {layout, "torchtransient"})[number % 2 :: 2]:
        with pytest.raises(StorageError, match=f"got one of '{layout}'"):
            Capture.read(path, other, wall_size=0.6, bin_width_s=16e-12)


@together("number", range(len(foreign_files())))
def test_every_layout_names_what_it_assumes(tmp_path, number):
    """An argument that a file takes and does not need is in `assumed` without it, whether others are given or not."""
    layout, path = foreign_file(tmp_path, number)
    capture, needed = read_answered(path)
    assert capture.metadata.get("format", layout) == layout
    left_open = {}
    for name in ANSWERS.keys() - needed.keys() - {"frame"}:
        try:
            Capture.read(path, **needed, **{name: ANSWERS[name]})
        except StorageError:
            assert name not in capture.metadata.get("assumed", {})
        else:
            left_open[name] = ANSWERS[name]
    for name in left_open:
        others = {other: value for other, value in left_open.items() if other != name}
        for given in ({}, others):
            found = Capture.read(path, **needed, **given)
            assert name in found.metadata.get("assumed", {}), f"{layout}: {name}= with {sorted(given)} given"


@together("number", range(len(foreign_files())))
def test_every_layout_names_what_it_does_not_read(tmp_path, number):
    layout, path = foreign_file(tmp_path, number, unheard_of=1.0)
    capture, _ = read_answered(path)
    # Files that this library writes hold nothing else; those of others may.
    assert "unheard_of" in capture.metadata.get("not_read", []), layout
    if number < len(HOLDABLE):
        assert capture.metadata["not_read"] == ["unheard_of"], layout


def test_files_of_no_layout(tmp_path):
    write_mat(tmp_path / "a.mat", {"something": [[1.0, 2.0]]})
    (tmp_path / "a.json").write_text('{"something": [1.0, 2.0]}')
    for name in ("a.mat", "a.json"):
        with pytest.raises(StorageError, match="holds something"):
            Capture.read(tmp_path / name)
        for layout in set(ENDINGS) - {"torchtransient"}:
            with pytest.raises(StorageError):
                Capture.read(tmp_path / name, layout, wall_size=1.0, bin_width_s=16e-12)


def test_the_hidden_side_is_that_of_the_sensor_without_normals(tmp_path):
    bare = replace(grids(legs=False, wall=SQUARE, size=(4, 4))["confocal"], sensor_normals=None, laser_normals=None)
    assert back(tmp_path / "a.mat", "rect_data", made(bare, FROM_ZERO)) is not None

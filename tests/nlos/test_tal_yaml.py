"""Scene files of y-tal: what their entries mean, from the syntax of its examples, and what is refused."""

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.sweeps import together
from torchtransient.errors import SceneError, StorageError
from torchtransient.scenes import rotate, scale, translate

OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
GEOMETRY = """
geometry:
- name: letter
  description: >
    Hidden geometry of the scene
  mesh:
    type: obj
    filename: ../meshes/letter.obj
  displacement_x: 0.1
  displacement_y: 0.2
  displacement_z: 1.0  # depth
  rot_degrees_x: 10.0
  rot_degrees_y: 20.0
  rot_degrees_z: 30.0
  scale_x: 1
  scale_y: 2
  scale_z: 0.5
  material:
    id: white
- name: ball
  mesh:
    type: sphere
  material:
    id: copper
    alpha: 0.2
- name: relay_wall
  mesh:
    type: rectangle
  displacement_x: 0.0
  displacement_y: 0.0
  displacement_z: 0.0
  scale_x: 1  # 1: relay wall is 2x2
  scale_y: 0.5
  scale_z: 1
  material:
    id: white
relay_wall: relay_wall  # must correspond to a geometry name above
"""
HEAD = """
# comments
name: letter-single
mitsuba_variant: llvm_ad_mono
integrator_nlos_hidden_geometry_sampling: true
sample_count: 10_000
simultaneous_scan: true
num_bins: 320
bin_width_opl: 0.003
start_opl: 1.95
sensor_width: 8
sensor_height: 6
"""


CUSTOM = """
    id: custom
    text: |
      <bsdf type="twosided">
        <bsdf type="diffuse">
          <texture type="checkerboard" name="reflectance">
            <rgb name="color0" value="0.1, 0.2, 0.3"/>
            <spectrum name="color1" value="0.5"/>
            <float name="unused" value="2"/>
            <integer name="count" value="3"/>
            <boolean name="smooth" value="true"/>
            <string name="filter" value="box"/>
          </texture>
        </bsdf>
      </bsdf>
"""


@pytest.fixture
def read(tmp_path):
    """What comes of a text in y-tal's layout: a folder with a file of its name, meshes beside the folder above."""
    folder = tmp_path / "quickstart" / "letter-single"
    folder.mkdir(parents=True)
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "letter.obj").write_text(OBJ)

    def made(text=HEAD + GEOMETRY):
        (folder / "letter-single.yaml").write_text(text)
        found = tt.nlos.read_setup(folder / "letter-single.yaml")
        assert repr(tt.nlos.read_setup(folder)) == repr(found)  # a folder is its file
        return found

    return made


def scan_of(read, entries, head=HEAD, geometry=GEOMETRY):
    return read(f"{head}{entries}\n{geometry}")["scan"]


def test_a_single_scan(read):
    found = read()
    assert set(found) == {"hidden", "scan", "time_axis", "frequencies", "spp", "bounces", "energy", "variant"}
    assert (found["variant"], found["spp"], found["bounces"], found["energy"]) == ("llvm_ad_mono", 10000, "all", 1.0)
    assert found["time_axis"] == tt.TimeAxis(1.95, 0.003, 320) and found["frequencies"] is None
    scan = found["scan"]
    assert scan.kind == "single" and scan.shape == (6, 8) and not scan.first_and_last_leg
    assert scan.laser_points.tolist() == [0, 0, 0]
    for origin in (scan.sensor_origin, scan.laser_origin):
        assert origin.tolist() == [-0.5, 0.0, 0.25]
    # the middles of 8 x 6 cells of a wall of 2 m x 1 m
    np.testing.assert_allclose(scan.sensor_points[0, :, 0], -1 + (np.arange(8) + 0.5) / 4)
    np.testing.assert_allclose(scan.sensor_points[:, 0, 1], -0.5 + (np.arange(6) + 0.5) / 6)
    assert tt.nlos.Wall.of(scan.wall).height == pytest.approx(1.0)
    bare = read("geometry:" + GEOMETRY.split("geometry:")[1])
    assert (bare["variant"], bare["spp"], bare["time_axis"]) == (None, 1_000_000, tt.TimeAxis(0.0, 0.003, 4096))


def test_shapes_and_materials(read, tmp_path):
    hidden = read()["hidden"]
    assert set(hidden) == {"letter", "ball"}
    letter = hidden["letter"]
    assert letter["type"] == "obj" and letter["filename"] == str(tmp_path / "meshes" / "letter.obj")
    turned = rotate([0, 0, 1], 30) @ rotate([0, 1, 0], 20) @ rotate([1, 0, 0], 10)
    expected = translate([0.1, 0.2, 1.0]) @ turned @ scale([1, 2, 0.5])
    np.testing.assert_allclose(letter["to_world"], expected, atol=1e-12)
    assert letter["bsdf"] == {"type": "diffuse", "reflectance": {"type": "rgb", "value": [1.0, 1.0, 1.0]}}
    assert hidden["ball"]["bsdf"]["material"] == "Cu" and hidden["ball"]["bsdf"]["alpha"] == 0.2


def test_kinds_of_scans(read):
    scan = scan_of(read, "scan_type: confocal\nlaser_width: 8\nlaser_height: 6\naccount_first_and_last_bounces: true")
    assert scan.kind == "confocal" and scan.first_and_last_leg and scan.shape == (6, 8)
    assert torch.equal(scan_of(read, "scan_type: confocal").laser_points, scan.sensor_points)
    equal = "scan_type: exhaustive\nintegrator_force_equal_illumination_scanning: true"
    assert scan_of(read, equal).shape == (6, 8, 6, 8)
    # Where the laser looks, in sensor points.
    scan = scan_of(read, "laser_lookat_x: 2\nlaser_lookat_y: 4.5\nlaser_x: 0.3\nlaser_y: null")
    np.testing.assert_allclose(scan.laser_points, [-1 + 2 * 2 / 8, -0.5 + 4.5 / 6, 0])
    assert scan.laser_origin.tolist() == [0.3, 0.0, 0.25]


def test_exhaustive_with_an_aperture(read):
    scan = scan_of(
        read, "scan_type: exhaustive\nlaser_width: 2\nlaser_height: 3\nlaser_aperture_start_x: 0.1\n"
        "laser_aperture_start_y: 0.2\nlaser_aperture_end_x: 0.9\nlaser_aperture_end_y: 0.8",
        HEAD.replace("simultaneous_scan: true", "simultaneous_scan: false"),
    )  # fmt: skip
    assert scan.shape == (3, 2, 6, 8)
    # y-tal: the middles of 2 x 3 cells between the apertures, on a wall from -1 to 1 and -0.5 to 0.5
    np.testing.assert_allclose(scan.laser_points[0, :, 0], [-0.4, 0.4], atol=1e-12)
    np.testing.assert_allclose(scan.laser_points[:, 0, 1], [-0.2, 0.0, 0.2], atol=1e-12)


def test_frequencies_are_those_of_a_transform_of_the_bins(read):
    text = HEAD.replace("320", "2048").replace("1.95", "0.0")
    found = read(text + "histogram_mode: frequency\nwl_mean: 0.06\nwl_sigma: 0.06\n" + GEOMETRY)
    # 1 / 0.06 per metre with 3 sigma = 3 / (6 * 0.06) on a grid of 1 / (2048 * 0.003)
    window = 2048 * 0.003
    expected = np.arange(np.floor(window / 0.06 - window / 0.12), np.ceil(window / 0.06 + window / 0.12) + 1) / window
    np.testing.assert_allclose(found["frequencies"].frequencies, expected)
    assert found["time_axis"] is None


def test_the_other_side_of_a_wall(read):
    behind = GEOMETRY.replace("scale_z: 1\n", "scale_z: -1\n", 2)
    scan = scan_of(read, "sensor_z: -0.25\nlaser_z: -0.25", geometry=behind)
    assert scan.sensor_normals[0, 0].tolist() == [0, 0, -1]
    with pytest.raises(SceneError, match="sensor_origin in front of the wall"):
        scan_of(read, "", geometry=behind)


def test_laser_emission(read):
    for entries, expected in (
        ("laser_emission: 0.5, 1.0, 2.0", {"type": "rgb", "value": [0.5, 1.0, 2.0]}), ("laser_emission: 2, 2, 2", 2.0),
        ("laser_emission_mode: mono\nlaser_emission: 3.5", 3.5), ("laser_emission_mode: mono", 1.0),
        ('laser_emission_mode: spectrum\nlaser_emission: "400:1, 700:2"',
         {"type": "spectrum", "value": [(400.0, 1.0), (700.0, 2.0)]}),
        ("laser_emission_mode: spectrum\nlaser_emission: 2", 2.0),
    ):  # fmt: skip
        assert read(f"{HEAD}{entries}\n{GEOMETRY}")["energy"] == expected
    for text in ("400:1", "400:1, 700", "400:1:2, 700:1", "1 2", "400:x, 700:1"):
        with pytest.raises(SceneError, match="laser_emission: expected"):
            read(f'{HEAD}laser_emission_mode: spectrum\nlaser_emission: "{text}"\n{GEOMETRY}')


def test_bounces_of_mitransient(read):
    """By largest depth, filter (a bounce less), and whether light of less than three bounces is left out."""
    for depth, only, discard, bounces in (
        (-1, -1, "false", "all"), (-1, -1, "true", "all"), (-1, 2, "false", (3,)), (3, -1, "false", (2, 3)),
        (4, -1, "true", (3, 4)), (6, 3, "true", (4,)),
    ):  # fmt: skip
        names = "integrator_max_depth", "integrator_filter_bounces", "integrator_discard_direct_paths"
        entries = "\n".join(f"{name}: {value}" for name, value in zip(names, (depth, only, discard), strict=True))
        assert read(f"{HEAD}{entries}\n{GEOMETRY}")["bounces"] == bounces
    with pytest.raises(SceneError, match="leave no light"):
        read(f"{HEAD}integrator_max_depth: 2\nintegrator_filter_bounces: 3\n{GEOMETRY}")


def with_custom(xml):
    custom = f"\n    id: custom\n    text: |\n      {xml}\n"
    return HEAD + GEOMETRY.replace("\n    id: white\n", custom, 1)


def test_custom_materials(read):
    bsdf = read(HEAD + GEOMETRY.replace("\n    id: white\n", CUSTOM, 1))["hidden"]["letter"]["bsdf"]
    assert bsdf["type"] == "twosided"
    reflectance = bsdf["bsdf_0"]["reflectance"]
    assert reflectance == {
        "type": "checkerboard", "color0": {"type": "rgb", "value": [0.1, 0.2, 0.3]}, "color1": 0.5, "unused": 2.0,
        "count": 3, "smooth": True, "filter": "box",
    }  # fmt: skip
    assert type(reflectance["count"]) is int and type(reflectance["unused"]) is float
    text = "<!-- a --><bsdf type='a'><rgb name='b' value='0.5'/><boolean name='c' value='false'/></bsdf>"
    found = read(with_custom(text))["hidden"]["letter"]["bsdf"]
    assert found == {"type": "a", "b": {"type": "rgb", "value": [0.5, 0.5, 0.5]}, "c": False}
    for xml, message in (
        ("<bsdf type='diffuse'><ref id='x'/></bsdf>", "<ref> in a material"), ("<shape type='sphere'/>", "got <shape>"),
        ("<bsdf/>", "has no type"), ("<bsdf type='diffuse'", "cannot be read"),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><bsdf type='diffuse'/>", "a declaration"),
        ("<bsdf type='diffuse'><rgb name='reflectance' value='1 2'/></bsdf>", "one or three"),
        ("<bsdf type='diffuse'><float name='a' value='x'/></bsdf>", "finite number"),
    ):  # fmt: skip
        with pytest.raises(SceneError, match=message):
            read(with_custom(xml))


@together(
    "old, new, message",
    [
        ("num_bins: 320", "num_bin: 320", "unknown entry 'num_bin'. Did you mean 'num_bins'"),
        ("num_bins: 320", "num_bins: many", "num_bins: expected a finite number, got 'many'"),
        ("num_bins: 320", "num_bins: 320\nnum_bins: 330", "num_bins stands twice"),
        ("sensor_width: 8", "sensor_width: 8\nscan_type: biaxial", "single, confocal, exhaustive"),
        ("simultaneous_scan: true", "simultaneous_scan: maybe", "stands|true or false"),
        ("sample_count: 10_000", "integrator_nlos_laser_sampling: false", "laser_sampling: false is not supported"),
        ("sample_count: 10_000", "scan_type: confocal\nlaser_width: 4", "lights its own sensor points"),
        ("sample_count: 10_000", "scan_type: exhaustive\nintegrator_force_equal_illumination_scanning: false",
         "field of view"),
        ("sample_count: 10_000", "histogram_mode: frequency", "an entry 'wl_mean'"),
        ("sample_count: 10_000", "laser_lookat_x: 0", "takes 0 for null"),
        ("sample_count: 10_000", "laser_emission: 1.0, 2.0", "expected 3 numbers"),
        ("relay_wall: relay_wall", "relay_wall: wall", "expected one of letter, ball, relay_wall"),
        ("relay_wall: relay_wall", "# none", "an entry 'relay_wall'"),
        ("name: ball", "name: letter", "letter stands there more than once"),
        ("letter.obj", "other.obj", "no file '../meshes/other.obj'"),
        ("    alpha: 0.2\n", "", "an entry 'alpha'"),
        ("rot_degrees_x: 10.0", "rot_degree_x: 10.0", "geometry 0: unknown entry 'rot_degree_x'"),
    ],
)  # fmt: skip
def test_what_is_refused(read, old, new, message):
    text = HEAD + GEOMETRY
    assert old in text
    with pytest.raises(SceneError, match=message):
        read(text.replace(old, new, 1))


def test_what_is_no_scene(read, tmp_path):
    """Nothing is executed, and files must be there."""
    alone = GEOMETRY[: GEOMETRY.index("- name: letter")] + GEOMETRY[GEOMETRY.index("- name: relay_wall") :]
    for text, error, message in (
        (HEAD + alone, SceneError, "expected a hidden shape"),
        ("geometry: []\n", SceneError, "y-tal scene: .*geometry"),
        ("relay_wall: wall\n", SceneError, "y-tal scene: .*geometry"), ("- 1\n- 2\n", SceneError, "names and values"),
        ("name: !!python/object/apply:os.system ['echo']\n", StorageError, "cannot be read"),
        ("name: [1, 2\n", StorageError, "expected YAML"),
    ):  # fmt: skip
        with pytest.raises(error, match=message):
            read(text)
    with pytest.raises(StorageError, match="cannot be read"):
        tt.nlos.read_setup(tmp_path / "missing.yaml")

"""What of objects that were taken as they are is refused or described, one by one. Nothing is rendered."""

from __future__ import annotations

from types import SimpleNamespace

import mitsuba as mi
import pytest

import torchtransient as tt
from torchtransient import plugins
from torchtransient.rendering import taken
from torchtransient.rendering.build_options import BuildOptions
from torchtransient.rendering.films import Histogram


@pytest.fixture(autouse=True, scope="module")
def variant():
    """One whose plugins are known."""
    mi.set_variant("llvm_ad_rgb")
    plugins.sync()



@pytest.mark.parametrize(
    ("own", "asked", "fits"),
    [(3, None, True), (3, 3, True), (3, 5, False), (3, -1, False), (-1, -1, True), (-1, 3, False), (3, 1, False)],
)
def test_depths_of_integrators_that_were_taken(own, asked, fits):
    integrator = mi.load_dict({"type": "transient_path", "max_depth": own})
    if fits:
        taken._check_integrator(integrator, BuildOptions(max_depth=asked))
    else:
        with pytest.raises(tt.errors.SceneError, match=rf"was taken as it is, and max_depth={asked} is asked for"):
            taken._check_integrator(integrator, BuildOptions(max_depth=asked))
    with pytest.raises(tt.errors.SceneError, match="and transient_prbvolpath is asked for"):
        taken._check_integrator(integrator, BuildOptions(max_depth=asked, integrator="transient_prbvolpath"))


def test_integrators_of_pictures_that_were_taken():
    with pytest.raises(tt.errors.SceneError, match="PathIntegrator was taken as it is, and a transient one is"):
        taken._check_integrator(mi.load_dict({"type": "path", "max_depth": 3}), BuildOptions())


def test_films_that_were_taken(monkeypatch):
    """With the sampler, pulses and steady image that they have."""
    one, other = (tt.TimeAxis(0.0, 1.0, n) for n in (3, 5))
    own, pulse = Histogram(one), tt.Pulse.gaussian(0.5)
    monkeypatch.setattr(taken, "layout_of_film", lambda film: own)
    monkeypatch.setattr(taken, "is_time_resolved", lambda film: True)

    def said(keeps_steady=True, **options):
        film = SimpleNamespace(keeps_steady=keeps_steady)
        try:
            taken._check_sensor(2, SimpleNamespace(film=lambda: film), BuildOptions(**options))
        except tt.errors.SceneError as error:
            return str(error).split("sampler, and ")[1].split(", or make")[0]
        return None

    assert said() is None and said(film=own, transient=True) is None and said(keeps_steady=False, steady=False) is None
    for options, words in (
        ({"sampler": "stratified"}, "sampler"), ({"pulse": pulse}, "pulse"), ({"irf": pulse}, "irf"),
        ({"steady": False}, "steady"), ({"film": Histogram(other), "transient": True}, "time_axis"),
        # What a film is of is asked where it is to be one of time.
        ({"film": own}, "time_axis"),
    ):  # fmt: skip
        assert said(**options) == f"{words} would change it. Leave it out"
    assert said(irf=pulse, steady=False) == "irf, steady would change it. Leave them out"


def test_variants_of_what_was_taken():
    each = [SimpleNamespace(variant=variant) for variant in ("llvm_ad_rgb", "llvm_ad_rgb", "llvm_ad_mono")]
    taken.check_variant(tuple(each[:2]), None), taken.check_variant(tuple(each[:2]), "llvm_ad_rgb")
    taken.check_variant((), "llvm_ad_mono")
    for objects, variant, wrong, wanted in (
        (each, None, "mono", "rgb"), (each[:1], "llvm_ad_mono", "rgb", "mono"), (each[::-1], None, "rgb", "mono"),
    ):  # fmt: skip
        with pytest.raises(tt.errors.SceneError, match=f"object of llvm_ad_{wrong} .* rendered in llvm_ad_{wanted}"):
            taken.check_variant(tuple(objects), variant)
    taken.refuse("it", ())
    with pytest.raises(tt.errors.SceneError, match="it needs a scene that is described; first is a Mitsuba object"):
        taken.refuse("it", ("first", "second"))
    tree = {"a": {"b": taken.Taken(1, "x")}, "c": [taken.Taken(2, "y")], "d": taken.Taken(3, "z"), "e": 4}
    assert [one.value for one in taken.taken_below(tree)] == [1, 3]


def described(change=lambda mesh: None, **more):
    mesh = mi.load_dict({"type": "cube", "bsdf": {"type": "diffuse", "reflectance": 0.3}, **more})
    change(mesh)
    return taken._described_mesh(mesh)


def test_meshes_that_are_more_than_arrays():
    """With attributes, light, a sensor, a medium or a surface of another kind they are taken as they are."""
    found = described()
    assert found["vertices"].shape == (24, 3) and found["faces"].shape == (12, 3)
    assert found["normals"].shape == (24, 3) and found["texcoords"].shape == (24, 2)
    assert found["bsdf"]["reflectance"] == {"type": "uniform", "value": pytest.approx(0.3)}
    assert set(found) == {"type", "vertices", "faces", "bsdf", "normals", "texcoords"}
    colour = described(bsdf={"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.1, 0.2, 0.7]}})
    assert colour["bsdf"]["reflectance"]["value"] == pytest.approx([0.1, 0.2, 0.7])
    assert described(silhouette_sampling_weight=0.25)["silhouette_sampling_weight"] == 0.25
    assert described(lambda mesh: mesh.add_attribute("vertex_heat", 1, [0.5] * 24)) is None
    for more in (
        {"light": {"type": "area"}}, {"sensor": {"type": "irradiancemeter", "film": {"type": "hdrfilm"}}},
        {"interior": {"type": "homogeneous"}}, {"bsdf": {"type": "conductor"}},
        {"bsdf": {"type": "diffuse", "reflectance": {"type": "checkerboard"}}},
    ):  # fmt: skip
        assert described(**more) is None
    empty = mi.Mesh("empty", 3, 0, props=mi.Properties())
    assert taken._described_mesh(empty) is None

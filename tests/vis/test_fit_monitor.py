"""Fits as they are watched: what pages, figures and logs hold of a loop whose numbers are known."""

from __future__ import annotations

import json
import re
import sys
import time
import types

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.sweeps import together
from torchtransient.errors import ArgumentError, ShapeError, StorageError

AXIS = tt.TimeAxis(2.0, 0.5, 4)
TARGET = torch.rand(3, 4, 5, 6, generator=torch.Generator().manual_seed(0)) + 0.1


def fitted(steps=21, **given):
    """A monitor of a loop that brings a colour to 0.7, from 0.2; light is the colour times the target over 0.7."""
    colour = torch.nn.Parameter(torch.full((3,), 0.2))
    settings = {"target": TARGET, "pixels": [(1, 2)], "truth": {"colour": [0.7] * 3}, "axis": AXIS}
    monitor = tt.vis.FitMonitor({"colour": colour}, **settings | {"every": 10} | given)
    for step in range(steps):
        light = TARGET * (colour / 0.7)[:, None, None, None]
        loss = (light - TARGET).square().mean()
        colour.grad = torch.ones(3)
        monitor.step({"data": loss, "prior": 1.0 + step}, light)
        with torch.no_grad():
            colour += 0.5 / steps
    return monitor


def saved(monitor, folder):
    """The data of the page."""
    monitor.save(folder / "fit.html")
    text = (folder / "fit.html").read_text(encoding="utf-8")
    return json.loads(re.search(r'id="data">(.*?)</script>', text, re.DOTALL)[1])


def test_a_page_has_losses_parameters_and_light(tmp_path):
    data = saved(fitted(), tmp_path)
    loss, noise, colour = data["panels"]
    assert [curve["label"] for curve in loss["curves"]] == ["data", "prior"] and loss["log"]
    assert loss["curves"][1]["x"] == list(range(21)) and loss["curves"][1]["y"] == list(range(1, 22))
    steps = [0, 10, 20]
    assert noise["curves"][0]["x"] == [10, 20] and noise["curves"][0]["y"] == [0, 0]
    lines, aims = colour["curves"][:3], colour["curves"][3:]
    for line, aim in zip(lines, aims, strict=True):
        assert line["x"] == steps and aim["dashed"] and aim["y"] == [0.7, 0.7]
        assert line["y"] == pytest.approx([0.2 + 0.5 * step / 21 for step in steps], rel=1e-5)
    assert [moment["step"] for moment in data["moments"]] == steps
    (pixel,) = data["moments"][1]["panels"]
    target, now = pixel["curves"]
    measured = TARGET[:, :, 1, 2].sum(0)
    assert target["x"] == [2.25, 2.75, 3.25, 3.75] and target["y"] == pytest.approx(measured.tolist(), rel=1e-4)
    share = (0.2 + 0.5 * 10 / 21) / 0.7
    assert now["y"] == pytest.approx((share * measured).tolist(), rel=1e-4)
    assert [picture["title"] for picture in data["fixed"]] == ["start", "target"]
    assert all(len(moment["pictures"]) == 2 for moment in data["moments"])


def test_the_noise_is_that_of_recent_gradients(tmp_path):
    """A constant of 1 and white noise of spread 2, after gradients a thousand times larger: 4 of 5 parts are noise."""
    generator = torch.Generator().manual_seed(3)
    x = torch.zeros(100, requires_grad=True)
    monitor = tt.vis.FitMonitor({"x": x}, every=10)
    for step in range(101):
        x.grad = torch.full((100,), 1000.0) if step < 30 else 1 + 2 * torch.randn(100, generator=generator)
        monitor.step(1.0)
    curve = saved(monitor, tmp_path)["panels"][1]["curves"][0]
    assert curve["x"] == list(range(10, 101, 10)) and curve["y"][:2] == [0, 0]
    # From step 50 on, 20 pairs of 100 numbers: a spread of about 0.8 / sqrt(2000) = 0.02.
    assert curve["y"][4:] == pytest.approx([0.8] * 6, rel=0.1)


@together("look_ms", [0.3, 3.0])
def test_looks_take_one_hundredth_of_the_time(tmp_path, monkeypatch, look_ms):
    """By a clock that goes on by 3 ms in each step of the loop, and by so much where light is read."""
    now = [5.0]
    spent = 0.0
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])

    class Output:
        axis = None

        @property
        def transient(self):
            now[0] += look_ms / 1e3 / 10
            return TARGET

    monitor = tt.vis.FitMonitor({"x": torch.ones(3, requires_grad=True)}, target=TARGET)
    output = Output()
    for _ in range(1000):
        now[0] += 3e-3
        begin = now[0]
        monitor.step(1.0, output)
        spent += now[0] - begin
    steps = [moment["step"] for moment in saved(monitor, tmp_path)["moments"]]
    assert steps[0] == 0 and 0.004 * (now[0] - 5.0) < spent < 0.0105 * (now[0] - 5.0)
    assert np.ptp(np.diff(steps[:-1])) <= 1


def test_long_fits_keep_evenly_spread_moments(tmp_path):
    monitor = tt.vis.FitMonitor({"x": torch.zeros(2)}, target=TARGET, every=1)
    for _ in range(500):
        monitor.step(1.0, TARGET)
    steps = [moment["step"] for moment in saved(monitor, tmp_path)["moments"]]
    assert steps[0] == 0 and steps[-1] == 499 and len(steps) <= 121
    assert len(set(np.diff(steps[:-1]))) == 1


def test_large_parameters_have_a_mean_and_a_range(tmp_path):
    texture = torch.linspace(-1, 2, 31).reshape(31, 1)
    monitor = tt.vis.FitMonitor({"texture": texture}, truth={"texture": texture + 1})
    monitor.step(-1.0)
    loss, panel = saved(monitor, tmp_path)["panels"]
    mean, truth = panel["curves"]
    assert not loss["log"]
    assert mean["y"] == pytest.approx([0.5]) and mean["band"] == [[-1], [2]] and truth["y"] == pytest.approx([1.5] * 2)


def test_a_renderer_is_watched_by_its_keys(tmp_path):
    key = "red.reflectance.value"
    box = tt.scenes.cornell_box(8, max_depth=2, num_bins=16, start_opl=3.5, bin_width_opl=0.4)
    renderer = tt.TransientRenderer(tt.load(box, variant="llvm_ad_rgb"), [key], spp=4, physics="ignore")
    with torch.no_grad():
        target = renderer(seed=9)
    monitor = tt.vis.FitMonitor(renderer, target=target, pixels=[(4, 4)], every=2)
    for step in range(5):
        renderer.zero_grad()
        out = renderer(seed=step)
        loss = (out.transient - target.transient).square().mean()
        loss.backward()
        monitor.step(loss, out)
    data = saved(monitor, tmp_path)
    assert [panel["title"] for panel in data["panels"][2:]] == [key]
    assert data["panels"][1]["curves"][0]["label"] == key and data["panels"][1]["curves"][0]["x"] == [2, 4]
    assert data["moments"][0]["panels"][0]["x"] == "optical path length (m)"
    last = torch.tensor(data["moments"][-1]["panels"][0]["curves"][1]["y"])
    torch.testing.assert_close(last, out.transient[:, :, 4, 4].sum(0).detach(), rtol=1e-4, atol=1e-6)


def test_parameters_made_of_two(tmp_path):
    """Length and direction of a weight have gradients of their own; names do not end the page."""
    layer = torch.nn.utils.parametrizations.weight_norm(torch.nn.Linear(3, 2, bias=False))
    monitor = tt.vis.FitMonitor(layer, every=2)
    for step in range(5):
        layer.zero_grad()
        loss = layer(torch.ones(4, 3) + step).square().mean()
        loss.backward()
        monitor.step(loss)
    _, noise, *weights = saved(monitor, tmp_path)["panels"]
    assert [curve["label"] for curve in noise["curves"]] == [panel["title"] for panel in weights]
    assert [panel["title"] for panel in weights] == ["weight0", "weight1"]
    assert [len(panel["curves"]) for panel in weights] == [2, 6]
    monitor = tt.vis.FitMonitor({"</script><b>": torch.zeros(2)})
    monitor.step(1.0)
    assert saved(monitor, tmp_path)["panels"][1]["title"] == "</script><b>"


def test_a_figure_shows_the_state(tmp_path):
    monitor = fitted()
    figure = monitor.figure()
    pictures = [axes for axes in figure.axes if axes.images]
    expected = ["start", "target", "step 20"]
    assert [axes.get_title() for axes in pictures][:3] == expected
    np.testing.assert_allclose(pictures[1].images[0].get_array() / 255, tt.vis.tone_map(TARGET.sum(1)), atol=0.003)
    titles = [axes.get_title() for axes in figure.axes[4:]]
    assert titles == ["row 1, column 2", "loss", "noise of the gradient (1: random)", "colour"]
    monitor.save(tmp_path / "fit.png")
    assert (tmp_path / "fit.png").read_bytes().startswith(b"\x89PNG")


def test_images_are_light_without_histograms(tmp_path):
    monitor = tt.vis.FitMonitor({}, target=TARGET.sum(1))
    monitor.step(1.0, 0.5 * TARGET.sum(1))
    data = saved(monitor, tmp_path)
    assert data["moments"][0]["panels"] == [] and len(data["moments"][0]["pictures"]) == 2


def test_a_notebook_shows_one_figure(monkeypatch):
    """IPython's display, of which the second figure takes the place of the first."""
    shown = []
    handle = types.SimpleNamespace(update=lambda picture: shown.append(("update", picture)))

    def display(picture, display_id):
        shown.append(("display", picture))
        return handle

    module = types.ModuleType("IPython.display")
    module.display, module.Image = display, lambda data, format: data
    shell = types.ModuleType("IPython")
    shell.get_ipython = lambda: types.SimpleNamespace(kernel=1)
    monkeypatch.setitem(sys.modules, "IPython", shell)
    monkeypatch.setitem(sys.modules, "IPython.display", module)
    monitor = fitted()
    monitor.close()
    assert [kind for kind, _ in shown] == ["display", "update"]
    assert all(picture.startswith(b"\x89PNG") for _, picture in shown)


def test_tensorboard(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    monitor = fitted(log_dir=tmp_path / "log")
    monitor.close()
    log = EventAccumulator(str(tmp_path / "log"), {"scalars": 0, "images": 0}).Reload()
    colours = [f"parameter/colour/{n}" for n in range(3)]
    assert set(log.Tags()["scalars"]) == {"loss/data", "loss/prior", "gradient_noise/colour", *colours}
    prior, colour = log.Scalars("loss/prior"), log.Scalars("parameter/colour/1")
    assert [(event.step, event.value) for event in prior] == [(n, n + 1.0) for n in (0, 10, 20)]
    assert [event.step for event in colour] == [0, 10, 20]
    assert [event.value for event in colour] == pytest.approx([0.2 + 0.5 * n / 21 for n in (0, 10, 20)], rel=1e-5)
    assert log.Images("fit")[-1].step == 20 and log.Images("fit")[-1].width > 500


@pytest.mark.slow
def test_lightning(tmp_path):
    lightning = pytest.importorskip("lightning")

    class Module(lightning.LightningModule):
        def __init__(self):
            super().__init__()
            self.colour = torch.nn.Parameter(torch.tensor(0.2))

        def training_step(self, batch, batch_idx):
            light = TARGET * self.colour
            return {"loss": (light - TARGET).square().mean(), "output": light.detach()}

        def configure_optimizers(self):
            return torch.optim.SGD(self.parameters(), lr=0.1)

    module = Module()
    monitor = tt.vis.FitMonitor(module, target=TARGET, every=2)
    trainer = lightning.Trainer(
        accelerator="cpu", devices=1, max_epochs=2, logger=False, enable_checkpointing=False, barebones=False,
        enable_progress_bar=False, enable_model_summary=False, callbacks=[monitor.callback()],
        default_root_dir=tmp_path,
    )  # fmt: skip
    trainer.fit(module, torch.utils.data.DataLoader(torch.zeros(3), batch_size=1))
    data = saved(monitor, tmp_path)
    losses = data["panels"][0]["curves"][0]
    assert losses["x"] == list(range(6)) and losses["y"] == sorted(losses["y"], reverse=True)
    assert [moment["step"] for moment in data["moments"]] == [0, 2, 4]
    assert data["panels"][1]["curves"][0]["label"] == "colour"


@pytest.mark.browser
def test_the_page_in_a_browser(tmp_path):
    """The slider leads through the moments; nothing is loaded from elsewhere."""
    from support.browser import chromium

    fitted().save(tmp_path / "fit.html")
    with chromium() as browser:
        page = browser.new_page()
        said, asked = [], []
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto((tmp_path / "fit.html").as_uri())
        assert page.inner_text("#step") == "step 20"
        assert page.locator("#curves svg").count() == 3 and page.locator("#pixels svg").count() == 1
        assert page.locator("#pictures img").count() == 4
        curve = "#pixels path >> nth=1"
        last, place = page.get_attribute(curve, "d"), page.get_attribute(".cursor >> nth=0", "x1")
        page.fill("#slider", "0")
        assert page.inner_text("#step") == "step 0"
        assert page.get_attribute(curve, "d") != last
        assert float(page.get_attribute(".cursor >> nth=0", "x1")) < float(place)
        sizes = page.evaluate("[...document.images].map((image) => image.naturalWidth)")
    assert said == [] and sizes == [6] * 4
    assert all(url.startswith(("file:", "data:")) for url in asked)


def test_losses_that_are_not_finite_are_named(tmp_path):
    """One from a step on, another now and then, beside one that is finite; the axis stays logarithmic."""
    monitor = tt.vis.FitMonitor({"x": torch.zeros(2)}, target=TARGET, every=10)
    nan, inf = float("nan"), float("inf")
    for step in range(11):
        light = TARGET * (nan if step > 6 else 1.0)
        monitor.step({"data": nan if step > 6 else 1.0, "edge": inf if step in (3, 5) else 1.0, "prior": 2.0}, light)
    loss = saved(monitor, tmp_path)["panels"][0]
    labels = ["data, not finite from step 7", "edge, not finite in 2 steps from 3 on", "prior"]
    assert [curve["label"] for curve in loss["curves"]] == labels and loss["log"]
    assert loss["curves"][0]["y"] == [1] * 7 + [None] * 4
    monitor.save(tmp_path / "fit.png")
    assert [text.get_text() for text in monitor.figure().axes[4].get_legend().get_texts()] == labels


def test_refused(tmp_path):
    with pytest.raises(ShapeError, match="pixel"):
        tt.vis.FitMonitor({}, target=TARGET, pixels=[(5, 0)])
    with pytest.raises(ArgumentError, match=r"some of wall\.distance, lamp, got wall\."):
        tt.vis.FitMonitor({"wall.distance": torch.zeros(1), "lamp": torch.zeros(1)}, truth={"wall": 1.0})
    monitor = tt.vis.FitMonitor({}, target=TARGET)
    with pytest.raises(StorageError, match=r"fit\.foo' could not be written"):
        monitor.save(tmp_path / "fit.foo")
    with pytest.raises(ShapeError, match="target's"):
        monitor.step(1.0, TARGET[..., :4])
    for other in (TARGET[:, :3], types.SimpleNamespace(transient=TARGET, axis=tt.TimeAxis(9.0, 0.5, 4))):
        seen = tt.vis.FitMonitor({}, target=TARGET, axis=AXIS, every=10)
        with pytest.raises(ShapeError, match="the target's"):
            seen.step(1.0, other)
    beats = types.SimpleNamespace(beats=torch.ones(1, 2, 4, 5, 6), transient=None)
    with pytest.raises(ShapeError, match="spectra of beats"):
        tt.vis.FitMonitor({}).step(1.0, beats)
    with pytest.raises(StorageError, match="missing"):
        monitor.save(tmp_path / "missing" / "fit.html")

"""Chromium with a page of `tt.vis.view`, driven as a user does: by mouse and keyboard, and read from what it shows."""

from __future__ import annotations

import re
import shutil
from contextlib import contextmanager

from playwright.sync_api import sync_playwright

_NAMES = ("chromium", "chromium-browser", "google-chrome")
_SWITCHES = (
    "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync",
)  # fmt: skip
SCREEN = {"width": 1280, "height": 800}


class Shown:
    """A page that is ready."""

    def __init__(self, page):
        self.page = page
        self.errors = []
        self.asked = []
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("request", lambda request: self.asked.append(request.url))

    def open(self, address):
        self.page.goto(address)
        self.page.wait_for_function("window.torchtransient && window.torchtransient.ready", timeout=60_000)
        return self

    def settle(self):
        """Wait until the page has drawn what it was asked for."""
        self.page.evaluate(
            "async () => { let seen = -1; while (seen !== torchtransient.drawn) {"
            " seen = torchtransient.drawn; await new Promise((done) => setTimeout(done, 120)); } }"
        )
        assert self.errors == []

    def place(self, figure, x, y):
        """Where a point of a figure stands on the screen."""
        return self.page.evaluate(
            """([name, x, y]) => {
              const view = Bokeh.index.find_one(Bokeh.documents[0].get_model_by_name(name));
              const box = view.el.getBoundingClientRect(), frame = view.frame;
              return [box.left + frame.x_scale.compute(x), box.top + frame.y_scale.compute(y)];
            }""",
            [figure, x, y],
        )

    def click(self, figure, x, y):
        self.page.mouse.click(*self.place(figure, x, y))
        # A second click within this time is a double click.
        self.page.wait_for_timeout(350)
        self.settle()

    def drag(self, figure, start, end):
        self.page.mouse.move(*self.place(figure, *start))
        self.page.mouse.down()
        self.page.mouse.move(*self.place(figure, *((a + b) / 2 for a, b in zip(start, end, strict=True))), steps=4)
        self.page.mouse.move(*self.place(figure, *end), steps=4)
        self.page.mouse.up()
        self.settle()

    def press(self, *keys):
        for key in keys:
            self.page.keyboard.press(key)
        self.settle()

    def go(self, t):
        """To a position of the slider by the keyboard."""
        self.press("Home", *["Shift+ArrowRight"] * (t // 10), *["ArrowRight"] * (t % 10))

    def select(self, label, option):
        self.page.get_by_label(label, exact=True).select_option(label=option)
        self.page.evaluate("document.activeElement.blur()")
        self.settle()

    def toggle(self, label):
        self.page.get_by_role("button", name=label, exact=True).click()
        self.settle()

    @property
    def notes(self):
        return self.page.locator("text=/of those of the file|exact/").first.inner_text()

    @property
    def stated_error(self):
        """The largest relative error that the page states."""
        found = re.search(r"within ([\d.e+-]+) % of those", self.notes)
        return float(found.group(1)) / 100 if found else 0.0

    @property
    def stated_floor(self):
        """Size below which numbers are zero on the page."""
        found = re.search(r"sizes below ([\d.e+-]+) are zero", self.notes)
        return float(found.group(1)) if found else 0.0

    def rows(self):
        """The table of pixels: name, number at the cursor, its error, sum, place of the highest."""
        found = []
        for row in self.page.locator("tr.pixel").all():
            name = row.locator("td").nth(1).inner_text().strip()
            value, _, error = row.locator(".value").inner_text().partition("±")
            numbers = [_number(text) for text in (value, error or "0", row.locator(".sum").inner_text())]
            found.append((name, *numbers, _number(row.locator(".at").inner_text())))
        return found

    def picture(self, name="image"):
        """Colours of a picture as the page has them, rows of (r, g, b)."""
        return self.page.evaluate(
            """(name) => { const image = Bokeh.documents[0].get_model_by_name(name).data.image[0];
              return Array.from(image, (v) => [v & 255, (v >> 8) & 255, (v >> 16) & 255]); }""",
            name,
        )


def _number(text):
    plain = text.strip().split()[0] if text.strip() else "0"
    return float("nan") if plain == "none" else float(plain)


@contextmanager
def chromium():
    """A browser. Fails where there is none."""
    path = next(filter(None, map(shutil.which, _NAMES)), None)
    assert path is not None, "tests of pages need Chromium: apt-get install -y chromium"
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=path, args=list(_SWITCHES))
        yield browser
        browser.close()

"""Measure in a real browser that no page of the site scrolls sideways: `python docs/site/measure_widths.py`.

Needs Chromium (`--browser`, or `chromium` on the path) and the site of `make docs`. Each page is shown 320 and 1280
pixels wide; wide tables and blocks of code scroll inside themselves. `--screenshots FOLDER` keeps pictures.
"""

from __future__ import annotations

import argparse
import functools
import html
import http.server
import json
import re
import shutil
import subprocess
import tempfile
import threading
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
WIDTHS = (320, 1280)
SHOWN = ("index", "docs/index", "docs/sensors", "docs/gradients_table", "reference/losses", "gallery/index")
PAGE = """<!doctype html><title>widths</title><iframe id="frame" height="900"></iframe><pre id="found"></pre><script>
const pages = PAGES, widths = WIDTHS, found = [];
const frame = document.getElementById("frame");
const load = (page) => new Promise((done) => { frame.onload = done; frame.src = "/" + page; });
(async () => {
  for (const width of widths) for (const page of pages) {
    frame.style.width = width + "px";
    await load(page);
    const inside = frame.contentDocument;
    // The theme lets the column of a narrow page scroll by itself: that counts as the page.
    const columns = [...inside.querySelectorAll(".page, .main, .content, .article-container, article")];
    const scrolls = (box) => ["auto", "scroll"].includes(frame.contentWindow.getComputedStyle(box).overflowX);
    const boxes = [inside.documentElement, ...columns.filter(scrolls)];
    const needs = width + Math.max(...boxes.map((box) => box.scrollWidth - box.clientWidth));
    const wide = [];
    if (needs > width + 1) for (const node of inside.querySelectorAll("article *"))
      if (node.getBoundingClientRect().right > width + 1 && !node.closest(".table-wrapper, pre, .highlight"))
        wide.push(node.tagName + "." + node.className + ": " + node.textContent.slice(0, 60));
    found.push([page, width, needs, wide.slice(0, 3)]);
  }
  document.getElementById("found").textContent = JSON.stringify(found);
})();
</script>"""


class Quiet(http.server.SimpleHTTPRequestHandler):
    """The site, and the page that measures it."""

    measure = b""

    def do_GET(self) -> None:
        if self.path != "/measure":
            super().do_GET()
            return
        self.send_response(200)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.end_headers()
        self.wfile.write(self.measure)

    def log_message(self, format: str, *arguments: object) -> None:
        pass


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--site", type=Path, default=ROOT / "build" / "site" / "html")
    parser.add_argument("--browser", default=shutil.which("chromium") or shutil.which("google-chrome"))
    parser.add_argument("--screenshots", type=Path, help="folder for pictures of some pages")
    options = parser.parse_args()
    if options.browser is None or not (options.site / "index.html").is_file():
        parser.error("expected Chromium on the path and a site in build/site/html; run make docs")
    pages = sorted(path.relative_to(options.site).as_posix() for path in options.site.rglob("*.html"))
    pages = [page for page in pages if not page.startswith(("_", "search", "sg_"))]
    text = PAGE.replace("PAGES", json.dumps(pages)).replace("WIDTHS", json.dumps(WIDTHS))
    Quiet.measure = text.encode()
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(options.site)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    address = f"http://127.0.0.1:{server.server_port}"
    with tempfile.TemporaryDirectory() as profile:
        command = [options.browser, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={profile}"]
        dump = [*command, "--virtual-time-budget=600000", "--dump-dom", f"{address}/measure"]
        done = subprocess.run(dump, capture_output=True, text=True, check=True, timeout=540)
        if options.screenshots:
            options.screenshots.mkdir(parents=True, exist_ok=True)
            for page in SHOWN:
                for width in WIDTHS:
                    target = (options.screenshots / f"{page.replace('/', '-')}-{width}.png").resolve()
                    shot = [*command, f"--window-size={width},1400", f"--screenshot={target}"]
                    subprocess.run([*shot, f"{address}/{page}.html"], capture_output=True, check=True, timeout=120)
    server.shutdown()
    written = re.search(r'<pre id="found">(.*?)</pre>', done.stdout, flags=re.DOTALL)
    found = json.loads(html.unescape(written[1])) if written and written[1] else []
    wide = [row for row in found if row[2] > row[1] + 1]
    for page, width, needs, nodes in wide:
        print(f"{page}: {width} wide, needs {needs}: {'; '.join(nodes)}")
    print(f"{len(found)} of {len(pages) * len(WIDTHS)} measured, {len(wide)} scroll sideways")
    return int(bool(wide) or len(found) < len(pages) * len(WIDTHS))


if __name__ == "__main__":
    raise SystemExit(main())

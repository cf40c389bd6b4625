"""Make the site of the documentation: `make docs`, or `python docs/site/build.py`. Needs the extra `docs`.

Pages stand as they are in `docs/`, readable on a git host. Here they are laid out in `build/site/source` with what
a site needs besides: the tree of `docs/index.md`, the reference of every public name, a gallery of the training
examples. Warnings are errors.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
DOCS = ROOT / "docs"
sys.path[:0] = [str(HERE), str(ROOT)]

from docstrings import restructured  # noqa: E402
from reference import write_reference  # noqa: E402

_LINK = re.compile(r"(\]\()([^)\s#:]+)(#[^)\s]*)?\)")


def lay_out(source: Path) -> None:
    """Everything that Sphinx reads, in an empty folder."""
    shutil.rmtree(source, ignore_errors=True)
    pages = [ROOT / "README.md", ROOT / "CHANGELOG.md", *DOCS.glob("*.md"), ROOT / "benchmarks" / "README.md"]
    for page in pages:
        text = page.read_text(encoding="utf-8")
        for target in {page.parent / link for _, link, _ in _LINK.findall(text)}:
            copy_linked(target.resolve(), source)
        place = source / page.relative_to(ROOT)
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(to_the_front_page(text), encoding="utf-8")
    front = source / "README.md"
    front.rename(source / "index.md")
    with (source / "index.md").open("a", encoding="utf-8") as file:
        file.write(tree((DOCS / "index.md").read_text(encoding="utf-8")))
    write_reference(source / "reference")
    gallery(source)


def copy_linked(target: Path, source: Path) -> None:
    """Files that a page shows or links to, beside it as in the repository."""
    if target.is_file() and target.suffix != ".md":
        place = source / target.relative_to(ROOT)
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(target, place)


def to_the_front_page(text: str) -> str:
    """The README is the front page of the site."""
    return re.sub(r"\]\((\.\./)README\.md", r"](\1index.md", text)


def tree(index: str) -> str:
    """Sphinx's tables of contents, from the headings and links of `docs/index.md`."""
    parts = ["\n"]
    for group in re.split(r"^## ", index, flags=re.MULTILINE)[1:]:
        caption, _, rest = group.partition("\n")
        links = [link for _, link, _ in _LINK.findall(rest) if link.endswith(".md")]
        entries = [os.path.normpath(f"docs/{link}")[: -len(".md")] for link in links]
        entries = [entry for entry in entries if entry != "README"]
        if caption == "Start":
            entries.append("docs/index")
        if caption == "Learning":
            entries.append("gallery/index")
        parts.append(toctree(caption, entries))
    parts.append(toctree("Reference", ["reference/index"]))
    return "\n".join(parts)


def toctree(caption: str, entries: list[str]) -> str:
    return "\n".join(["```{toctree}", f":caption: {caption}", ":hidden:", "", *entries, "```", ""])


def gallery(source: Path) -> None:
    """The training examples with the titles of `docs/examples.md`, and the pictures that pages show of them."""
    texts = [page.read_text(encoding="utf-8") for page in (DOCS / "examples.md", *sorted(DOCS.glob("*.md")))]
    own = sections(texts[0])
    folder = source / "training_examples"
    folder.mkdir()
    (folder / "GALLERY_HEADER.rst").write_text(
        "Training examples\n=================\n\nThe scripts; their figures are in :doc:`/docs/examples`.\n",
        encoding="utf-8",
    )
    for script in sorted((ROOT / "training_examples").glob("*.py")):
        text = script.read_text(encoding="utf-8")
        if "__main__" not in text:  # what several of them share
            continue
        docstring = ast.get_docstring(ast.parse(text)) or ""
        first = re.split(r"[:.](?:\s|$)", docstring, maxsplit=1)[0].replace("\n", " ")
        title = next((title for title, body in own if f"python training_examples/{script.name}" in body), first)
        head = [title, "=" * len(title), "", *restructured(docstring.splitlines(), pages=False)]
        picture = picture_of(script, texts)
        thumbnail = f'\n# sphinx_gallery_thumbnail_path = "docs/{picture}"\n' if picture else ""
        content = 'r"""\n' + "\n".join(head) + '\n"""\n' + thumbnail + text.split('"""', 2)[2]
        (folder / script.name).write_text(content, encoding="utf-8")


def sections(text: str) -> list[tuple[str, str]]:
    """(title, text) of every section of a page."""
    return re.findall(r"^##+ (.*?)\n(.*?)(?=^##|\Z)", text, re.MULTILINE | re.DOTALL)


def picture_of(script: Path, texts: list[str]) -> str | None:
    """The first picture of a section that speaks of a script; one that has its name goes before."""
    shown = re.compile(r"!\[[^\]]*\]\(([^)]+\.png)\)")
    bodies = [body for text in texts for _, body in sections(text) if f"training_examples/{script.name}" in body]
    found = [picture for body in bodies for picture in shown.findall(body)]
    found += [picture for text in texts for picture in shown.findall(text) if script.stem in picture]
    return min(found, key=lambda picture: script.stem not in picture, default=None)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--output", type=Path, default=ROOT / "build" / "site")
    parser.add_argument("--keep-going", action="store_true", help="list all warnings before it fails")
    options = parser.parse_args()
    source, html, doctrees = (options.output / name for name in ("source", "html", "doctrees"))
    lay_out(source)
    for old in (html, doctrees):  # what was left of an earlier build would be found a second time
        shutil.rmtree(old, ignore_errors=True)
    command = [sys.executable, "-m", "sphinx", "-b", "html", "-c", str(HERE), "-d", str(doctrees)]
    command += ["-n", "-W", *(["--keep-going"] if options.keep_going else []), "-q", str(source), str(html)]
    environment = {**os.environ, "TORCHTRANSIENT_SITE": str(source), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=environment, check=False)
    if done.returncode == 0:
        print(f"the site: {html / 'index.html'}")
    return done.returncode


if __name__ == "__main__":
    raise SystemExit(main())

#!/usr/bin/env python3
"""Checks the links of the documentation, and builds it as a site with mdBook.

python3 scripts/site.py                                   checks links, headings and docs/SUMMARY.md
python3 scripts/site.py --build FOLDER [--repository URL] also builds the site, with target/doc as FOLDER/api

Pages keep their places and their links: the book's source is a copy of the Markdown files and their images in the
same folders. Links to other files of the repository lead to URL, or become plain text without one.
"""

import argparse
import html.parser
import os
import re
import shutil
import subprocess
import sys
import tempfile
import urllib.parse
from pathlib import Path

ROOT = Path(__file__).parents[1]
SUMMARY = Path("docs/SUMMARY.md")
NOTES = Path("docs/notes/README.md")
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")
# Pages without a place in the book: cases of tests, and pages of folders that only developers open.
OUTSIDE = ("tests/", "fuzz/", "crates/", "configs/", ".github/")


def tracked(*patterns):
    listed = subprocess.run(["git", "ls-files", "--", *patterns], cwd=ROOT, capture_output=True, text=True, check=True)
    return [Path(line) for line in listed.stdout.splitlines()]


def prose(text):
    """Returns the text with code blocks and inline code blanked out, so that only links and headings are left."""
    lines, fenced = [], False
    for line in text.splitlines():
        if line.lstrip().startswith("```"):
            fenced = not fenced
            line = ""
        lines.append("" if fenced else line)
    return "\n".join(lines)


def without_code(text):
    return re.sub(r"(`+)(.+?)\1", lambda code: " " * len(code.group()), text, flags=re.DOTALL)


def anchors(text):
    """Returns the anchors of a page's headings, as GitHub and mdBook make them."""
    found = []
    for heading in re.findall(r"^#{1,6} (.+)$", prose(text), re.MULTILINE):
        heading = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).strip().lower()
        name = re.sub(r"\s", "-", re.sub(r"[^\w\- ]", "", heading))
        found.append(name + (f"-{n}" if (n := sum(f == name for f in found)) else ""))
    return found


def links(page, text):
    """Yields line, target path within the repository (None: elsewhere), and anchor of every link of a page."""
    text = without_code(prose(text))
    for match in LINK.finditer(text):
        target, _, anchor = match.group(3).partition("#")
        line = text.count("\n", 0, match.start()) + 1
        if re.match(r"[a-z]+:", target):
            yield line, None, ""
        else:
            path = os.path.normpath(page.parent / urllib.parse.unquote(target)) if target else str(page)
            yield line, Path(path), anchor


def check():
    """Returns what is wrong with links, headings and the summary, a line each."""
    faults = []
    pages = {page: (ROOT / page).read_text(encoding="utf-8") for page in tracked("*.md")}
    for page, text in pages.items():
        for line, path, anchor in links(page, text):
            if path is None:
                continue
            if not (ROOT / path).exists():
                faults.append(f"{page}:{line}: no file {path}")
            elif anchor and path.suffix == ".md" and anchor not in anchors((ROOT / path).read_text(encoding="utf-8")):
                faults.append(f"{page}:{line}: no heading #{anchor} in {path}")
    for page in pages:
        contents = NOTES if str(page).startswith("docs/notes/") and page != NOTES else SUMMARY
        times = [path for _, path, _ in links(contents, pages[contents])].count(page)
        if page != SUMMARY and not str(page).startswith(OUTSIDE) and times != 1:
            faults.append(f"{contents}: lists {page} {times} times; list every page once")
    return faults


def linked(page, text, target_of):
    """Returns a page with every link outside of code blocks replaced by `target_of(path, match)`."""

    def replaced(match):
        target = match.group(3).partition("#")[0]
        if not target or re.match(r"[a-z]+:", target):
            return match.group()
        return target_of(Path(os.path.normpath(page.parent / target)), match)

    parts = re.split(r"(^```.*?^```)", text, flags=re.DOTALL | re.MULTILINE)
    return "".join(part if n % 2 else LINK.sub(replaced, part) for n, part in enumerate(parts))


def contents():
    """Returns the summary for mdBook: places from the root, all notes by group, and the page of the crates."""

    def of(page, text):
        return linked(page, text, lambda path, match: f"[{match.group(2)}]({path})")

    notes = []
    text = re.sub(r"\n  (?=\S)", " ", of(NOTES, (ROOT / NOTES).read_text(encoding="utf-8")))
    for line in text.splitlines():
        if line.startswith("## "):
            notes.append(f"  - [{line[3:]}]()\n")
        elif line.startswith("- ["):
            notes.append(f"    {line}\n")
    text = of(SUMMARY, (ROOT / SUMMARY).read_text(encoding="utf-8"))
    return re.sub(rf"^- .*{NOTES}.*\n", rf"\g<0>{''.join(notes)}", text, flags=re.MULTILINE) + "- [Crates](api.md)\n"


def crates():
    """Returns a page with the documentation of every published crate."""
    rows = []
    for manifest in sorted((ROOT / "crates").glob("*/Cargo.toml")):
        table = manifest.read_text(encoding="utf-8").partition("\n\n")[0]
        package = dict(re.findall(r'^(name|description|publish) = "?(.*?)"?$', table, re.MULTILINE))
        if package.get("publish") != "false":
            module = package["name"].replace("-", "_")
            rows.append(f"| [{package['name']}](api/{module}/index.html) | {package['description']} |\n")
    head = "# Crates\n\nTheir documentation, as `cargo doc --workspace --no-deps` makes it.\n\n"
    return f"{head}| crate | |\n|---|---|\n{''.join(rows)}"


def indexed(text):
    """Returns a link or a path with README.md as index.md: mdBook renames the page, but not the links to it."""
    return text.replace("README.md", "index.md")


def stage(source, repository):
    """Copies pages and images, with links out of the book led to the repository."""
    pages = [p for p in tracked("*.md") if not str(p).startswith(OUTSIDE) and p != SUMMARY]
    images = [p for p in tracked("docs/*") if p.suffix in {".png", ".svg", ".gif", ".jpg", ".webp"}]

    def led(path, match):
        if path in pages or path in images:
            return indexed(match.group())
        kind = "tree" if (ROOT / path).is_dir() else "blob"
        anchor = "".join(match.group(3).partition("#")[1:])
        return f"[{match.group(2)}]({repository}/{kind}/main/{path}{anchor})" if repository else match.group(2)

    texts = {page: linked(page, (ROOT / page).read_text(encoding="utf-8"), led) for page in pages}
    texts = {Path(indexed(str(page))): text for page, text in texts.items()}
    texts |= {Path("SUMMARY.md"): indexed(contents()), Path("api.md"): crates()}
    for path in [*images, *texts]:
        (source / path).parent.mkdir(parents=True, exist_ok=True)
    for path in images:
        shutil.copyfile(ROOT / path, source / path)
    for path, text in texts.items():
        (source / path).write_text(text, encoding="utf-8")


class Page(html.parser.HTMLParser):
    """References and names of an HTML page."""

    def __init__(self, text):
        super().__init__()
        self.references, self.names = [], set()
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        for key, value in attributes:
            if key in ("href", "src") and value:
                self.references.append(value)
            elif key in ("id", "name"):
                self.names.add(value)


def broken(site, with_api):
    """Returns the references of the built pages that lead nowhere."""
    pages = {path: Page(path.read_text(encoding="utf-8")) for path in site.rglob("*.html") if "api" not in path.parts}
    faults = []
    for path, page in pages.items():
        if path.name in ("print.html", "toc.html", "404.html"):
            continue
        for reference in page.references:
            parts = urllib.parse.urlsplit(reference)
            target = (path.parent / urllib.parse.unquote(parts.path)).resolve() if parts.path else path
            if parts.scheme or not with_api and "/api/" in str(target):
                continue
            if not target.exists():
                faults.append(f"{path.relative_to(site)}: {reference} is missing")
            elif parts.fragment and target in pages and urllib.parse.unquote(parts.fragment) not in pages[target].names:
                faults.append(f"{path.relative_to(site)}: {reference} has no such place")
    return faults


def build(site, repository, mdbook):
    """Builds the site in an empty folder, and returns what is wrong with it."""
    if site.exists():
        shutil.rmtree(site)
    with tempfile.TemporaryDirectory() as folder:
        book = Path(folder)
        shutil.copyfile(ROOT / "book.toml", book / "book.toml")
        stage(book / "src", repository)
        told = {"MDBOOK_OUTPUT__HTML__GIT_REPOSITORY_URL": repository} if repository else {}
        command = [mdbook, "build", "--dest-dir", str(site.resolve()), str(book)]
        subprocess.run(command, env=os.environ | told, check=True)
    documented = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "doc"
    if documented.exists():
        shutil.copytree(documented, site / "api")
    return broken(site.resolve(), documented.exists())


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--build", type=Path, metavar="FOLDER")
    parser.add_argument("--repository", metavar="URL", help="where links to other files lead")
    parser.add_argument("--mdbook", default="mdbook", help="the program [default: on PATH]")
    given = parser.parse_args()
    faults = check()
    if given.build and not faults:
        faults = build(given.build, given.repository, given.mdbook)
    print("".join(f"{fault}\n" for fault in faults), end="")
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()

"""What the site has beyond docs/: pages and files that stand elsewhere in the checkout, and equations as MathML.

The pages link to each other by their places in the checkout, as GitHub wants it. A page outside of docs/ (the README,
the changelog, ...) gets a place in the site, and so does every file and folder that a page links to. A folder becomes a
page that shows its pictures and lists its files, and a script becomes a page that shows it.
"""

import html
import json
import os
import posixpath
import re
from pathlib import Path

import matplotlib
from latex2mathml import converter
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
# Pages of the site that stand outside of docs/, and their places in the checkout.
PAGES = {
    "index.md": "README.md",
    "changelog.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
    "experiments/index.md": "experiments/README.md",
}
SOURCES = {".cff": "yaml", ".py": "python", ".toml": "toml"}  # files that are shown as pages, and their languages
_LINK = re.compile(r"(\]\()([^)\s#]+)(#[^)\s]*)?(?=\))")
_FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
_HIDDEN = "---\nsearch:\n  exclude: true\n---\n\n"  # from the search
_FIGURES = ("frames.png", "curves.png", "steering.png", "robustness.png", "policy.mp4")  # of a run, in this order


def place(page: str) -> str:
    """Where a page of the site is in the checkout."""
    return PAGES.get(page, page if page.startswith("experiments/") else f"docs/{page}")


def address(path: str) -> str:
    """Where a file or folder of the checkout is in the site, as the source of a page or as a file."""
    for page, source in PAGES.items():
        if path == source:
            return page
    if (ROOT / path).is_dir():
        return f"{path}/index.md"
    if Path(path).suffix in SOURCES:
        return f"{path}.md"
    return path.removeprefix("docs/")


def rewrite(text: str, page: str) -> tuple[str, set[str]]:
    """A page's text with its links to the checkout as links within the site, and the paths that they lead to.

    Args:
      text: Markdown.
      page: the page's own place in the site, such as ``index.md``.
    """
    here, found = posixpath.dirname(place(page)), set()

    def change(link: re.Match) -> str:
        target = link[2]
        if re.match(r"[a-z]+:", target):
            return link[0]
        path = posixpath.normpath(posixpath.join(here, target))
        found.add(path)
        return link[1] + posixpath.relpath(address(path), posixpath.dirname(page) or ".") + (link[3] or "")

    # Blocks of code stay as they are.
    parts, end = [], 0
    for block in [*_FENCE.finditer(text), None]:
        parts.append(_LINK.sub(change, text[end : block.start() if block else len(text)]))
        if block:
            parts.append(block[0])
            end = block.end()
    return "".join(parts), found


def listing(folder: Path) -> str:
    """Markdown of a folder: its pictures and film, the command that made it, and what it holds."""
    lines = [f"{_HIDDEN}# {folder.relative_to(ROOT).as_posix()}", ""]
    provenance = folder / "provenance.json"
    if provenance.exists():
        made = json.loads(provenance.read_text())
        lines += [f"Commit `{made.get('commit') or 'unknown'}`, by", "", "```sh", str(made.get("command")), "```", ""]
    for name in _FIGURES:
        if (folder / name).exists():
            film = f'<video src="{name}" controls loop muted></video>'
            lines += [film if name.endswith(".mp4") else f"![{name}]({name})", ""]
    for entry in sorted(folder.iterdir(), key=lambda entry: (entry.is_file(), entry.name)):
        # `./` makes a link of a name that could be taken for something else.
        lines.append(f"- [{entry.name}{'' if entry.is_file() else '/'}](./{entry.name})")
    return "\n".join(lines) + "\n"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that stand elsewhere, and what any page links to."""
    texts = {file.src_uri: file.content_string for file in files.documentation_pages()}
    texts |= {page: (ROOT / source).read_text() for page, source in PAGES.items()}
    for page in PAGES:
        files.append(File.generated(config, page, content=texts[page]))
    # It has the tables that formulas need, and every installation has it.
    font = Path(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSerif.ttf")
    files.append(File.generated(config, "math.ttf", content=font.read_bytes()))
    todo = [path for page, text in texts.items() for path in rewrite(text, page)[1]]
    while todo:
        path = todo.pop()
        if (uri := address(path)) in files.src_uris:
            continue
        if (ROOT / path).is_dir():
            text = listing(ROOT / path)
            files.append(File.generated(config, uri, content=text))
            todo += rewrite(text, uri)[1]
        elif language := SOURCES.get(Path(path).suffix):
            text = f"{_HIDDEN}# {path}\n\n````{language}\n{(ROOT / path).read_text()}````\n"
            files.append(File.generated(config, uri, content=text))
        elif (ROOT / path).is_file():
            files.append(File.generated(config, uri, abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, page: Page, **_) -> str:
    """Make links to the checkout links within the site."""
    return rewrite(markdown, page.file.src_uri)[0]


def mathml(tex: str, display: str) -> str:
    """A formula as MathML, which browsers draw without a script.

    Raises:
      PluginError: it has a command that the converter does not know.
    """
    made = converter.convert(tex, display=display)
    if unknown := re.search(r"\\[A-Za-z]+", made):
        raise PluginError(f"the formula {tex!r} has {unknown[0]!r}: expected a command that latex2mathml knows")
    return made


def on_page_content(html_text: str, **_) -> str:
    """Draw the formulas, which arithmatex marks."""
    for tag, opening, closing, display in (("span", r"\(", r"\)", "inline"), ("div", r"\[", r"\]", "block")):
        pattern = rf'<{tag} class="arithmatex">{re.escape(opening)}(.*?){re.escape(closing)}</{tag}>'
        html_text = re.sub(
            pattern,
            lambda found, tag=tag, display=display: (
                f'<{tag} class="formula">{mathml(html.unescape(found[1]).strip(), display)}</{tag}>'
            ),
            html_text,
            flags=re.DOTALL,
        )
    return html_text


def on_post_build(config: MkDocsConfig) -> None:
    """Refuse a site that would load anything from elsewhere when it is read."""
    loads = re.compile(r"""(?:src=|<link[^>]*href=|url\()["']?((?:https?:)?//[^"')\s>]+)""")
    for folder, _, names in os.walk(config.site_dir):
        for name in names:
            path = Path(folder, name)
            if path.suffix in (".html", ".css") and (found := loads.search(path.read_text(errors="replace"))):
                raise PluginError(f"{path} loads {found[1]}: expected nothing from another server")

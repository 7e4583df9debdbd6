"""One page that gathers what the experiments found, ours beside the paper's, as HTML and Markdown.

It reads the JSON files, pictures and videos below a folder and computes every sentence from their figures. The HTML
page holds its pictures and videos itself and needs nothing else.
"""

import base64
import html
import json
import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from fmpjax.errors import UserError
from fmpjax.experiments import barycenter, benchmark, curvature, generalization, static_teacher
from fmpjax.experiments.common import comparison, explorer, results, table
from fmpjax.experiments.common.results import Table, Verdict

COMPARISON = "results.json"  # of the matched comparison
VIDEO_LIMIT = 12_000_000  # bytes of all videos that a page holds; those beyond it are named instead


class Section(NamedTuple):
    """One result."""

    title: str
    table: Table | None  # None where nothing was measured, as below
    verdicts: Sequence[Verdict]
    picture: Path | None
    source: Path | None  # file of its figures
    provenance: Mapping[str, Any]
    command: str  # that makes it
    lines: Sequence[Mapping[str, str]] = ()  # of a table that the page's reader can sort and filter
    sentences: Sequence[str] = ()  # below the table
    courses: Path | None = None  # a second picture


_RUNS = " --run STANDING_RUN --walking WALKING_RUN"
_STUDIES: tuple[tuple[str, ModuleType, str], ...] = (
    ("Rewards beyond the rollout that they were fitted on", generalization, _RUNS),
    ("Dynamic against static path supervision", static_teacher, _RUNS),
    ("What a barycentric target keeps of the motion", barycenter, ""),
    ("Where the score has a minimum and the barycenter its maximum", curvature, ""),
)


def gather(folder: Path) -> list[Section]:
    """The sections of a report on the results below ``folder``, those without results included.

    Raises:
      UserError: there is no such folder, nothing in it, or a file that is not what it should be.
    """
    if not folder.is_dir():
        raise UserError(f"{folder} is not a folder: expected one with results of the experiments")
    sections = [
        _section(folder, "The matched comparison (Table I)", "ablate", "", COMPARISON, "curves.png", _comparison),
        *(
            _section(
                folder, title, module.NAME, needs, f"{module.NAME}.json", f"{module.NAME}.png", partial(_study, module)
            )
            for title, module, needs in _STUDIES
        ),
    ]
    if (compared := _benchmark(folder)) is not None:
        sections.append(compared)
    if not any(section.source for section in sections):
        names = ", ".join([COMPARISON, f"{benchmark.NAME}.json", *(f"{module.NAME}.json" for _, module, _ in _STUDIES)])
        raise UserError(f"no results below {folder}: expected one of {names}")
    return sections


def _benchmark(folder: Path) -> Section | None:
    """The section of the benchmark; None where there is none, as a page on the paper does not miss it."""
    title = "The benchmark: methods by motions, resets and seeds"
    sentences: list[str] = []

    def read(record: dict[str, Any]) -> tuple[Table, list[Verdict]]:
        sentences.extend(comparison.sentences(record))
        return comparison.table(record), []

    found = _section(folder, title, benchmark.NAME, "", f"{benchmark.NAME}.json", f"{benchmark.NAME}.png", read)
    if found.source is None:
        return None
    drawn = found.source.with_name(f"{benchmark.NAME}_courses.png")
    return found._replace(
        lines=explorer.read(found.source.with_suffix(".csv")),
        sentences=sentences,
        courses=drawn if drawn.exists() else None,
    )


def _section(
    folder: Path,
    title: str,
    module: str,
    needs: str,
    name: str,
    picture: str,
    read: Callable[[dict[str, Any]], tuple[Table, list[Verdict]]],
) -> Section:
    """The section of the file called ``name`` that is nearest below ``folder``, with the picture beside it."""
    command = f"fmpjax experiment {module}{needs} --out FOLDER"
    path = min(folder.rglob(name), key=lambda path: (len(path.parts), path), default=None)
    if path is None:
        return Section(title, None, (), None, None, {}, command)
    try:
        record = json.loads(path.read_text())
        drawn = path.with_name(picture)
        shown = drawn if drawn.exists() else None
        section = Section(title, *read(record), shown, path, record["provenance"], command)
        _source(section, folder, str, str)
        return section
    except (OSError, ValueError, KeyError, TypeError, IndexError, AttributeError) as error:
        raise UserError(
            f"{path} is no result of this version ({type(error).__name__}: {error}): write it again with {command}"
        ) from None


def _comparison(record: Mapping[str, Any]) -> tuple[Table, list[Verdict]]:
    final = table.final(record["evaluations"])
    headings, lines = table.lines(final)
    caption = "Last evaluations; means over seeds, with their 95 % intervals where there are several."
    caption = " ".join([caption, *table.notes(final)])
    named = [[f"{reset}: {method}", *cells] for reset, method, *cells in lines]
    return Table(caption, ["reset: method", *headings[2:]], named), table.verdicts(final)


def _study(module: ModuleType, record: Mapping[str, Any]) -> tuple[Table, list[Verdict]]:
    return module.table(record), module.verdicts(record)


# --- the pages -------------------------------------------------------------------------------------------------------

_TITLE = "Flow-Matched Motion Priors: what was found here"
_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #25303c; max-width: 72rem; margin: 2rem auto; padding: 0 1.5rem }
h1 { font-size: 1.7rem; line-height: 1.25 } h2 { font-size: 1.25rem; margin-top: 2.8rem }
table { border-collapse: collapse; font-size: .85rem; margin: .4rem 0 1rem }
.wide { overflow-x: auto }
caption { text-align: left; color: #5b6673; padding-bottom: .4rem; font-size: .9rem }
th, td { padding: .25rem .7rem; text-align: right; border-bottom: 1px solid #e3e7eb }
td { font-variant-numeric: tabular-nums }
th:first-child, td:first-child { text-align: left; white-space: nowrap }
th { border-bottom: 1px solid #25303c; font-weight: 600; vertical-align: bottom }
tr.paper td { color: #7a8691 }
ul.verdicts { list-style: none; padding: 0 }
ul.verdicts li { margin: .35rem 0; padding-left: 6.6rem; text-indent: -6.6rem }
.yes, .no { display: inline-block; width: 5.6rem; margin-right: 1rem; text-indent: 0; text-align: center;
  border-radius: .3rem; font-size: .8rem; color: #fff }
.yes { background: #3a8a6b } .no { background: #c8553d }
img { max-width: 100%; margin: .5rem 0 } video { max-width: 100%; width: 34rem }
figure { display: inline-block; margin: 0 1rem 1rem 0 } figcaption, .source { color: #5b6673; font-size: .85rem }
code { font-size: .9em; background: #f2f4f6; padding: .1em .3em; border-radius: .2em; overflow-wrap: anywhere }
"""


def _lead(sections: Sequence[Section]) -> str:
    verdicts = [verdict for section in sections for verdict in section.verdicts]
    return (
        "Figures of our own runs, the paper's beside them. The sentences below a table say whether the paper's claims "
        f"hold here; they are computed from the figures, and {sum(v.holds for v in verdicts)} of {len(verdicts)} hold."
    )


def page(sections: Sequence[Section], videos: Sequence[Path], root: Path) -> str:
    """The report as one HTML page that holds all it shows."""
    parts = [
        "<!doctype html>", '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">', f"<title>{_TITLE}</title>",
        f"<style>{_STYLE}{explorer.STYLE}</style></head><body>", f"<h1>{_TITLE}</h1>", f"<p>{_lead(sections)}</p>",
    ]  # fmt: skip
    for section in sections:
        parts.append(f"<h2>{html.escape(section.title)}</h2>")
        if section.table is None:
            parts.append(f"<p>Not measured here; <code>{html.escape(section.command)}</code> does so.</p>")
            continue
        parts += [_html_table(section.table), '<ul class="verdicts">', *map(_html_verdict, section.verdicts), "</ul>"]
        if section.sentences:
            parts.append(f"<ul>{''.join(f'<li>{html.escape(said)}</li>' for said in section.sentences)}</ul>")
        for picture in filter(None, (section.picture, section.courses)):
            parts.append(f'<img alt="{html.escape(section.title)}" src="{_data(picture, "image/png")}">')
        if section.lines:
            parts.append(explorer.page(section.lines))
        parts.append(f'<p class="source">{_source(section, root, html.escape, "<code>{}</code>".format)}</p>')
    parts.append("<h2>Videos</h2>")
    left = VIDEO_LIMIT
    for path in videos:
        name = html.escape(str(path.relative_to(root)))
        if path.stat().st_size > left:
            parts.append(f'<p class="source">{name} is left out, the page being large enough.</p>')
        else:
            left -= path.stat().st_size
            shown = f'<video controls muted loop preload="metadata" src="{_data(path, "video/mp4")}"></video>'
            parts.append(f"<figure>{shown}<figcaption>{name}</figcaption></figure>")
    if not videos:
        parts.append("<p>There are none below this folder.</p>")
    if any(section.lines for section in sections):
        parts.append(explorer.script())
    return "\n".join([*parts, "</body></html>"])


def text(sections: Sequence[Section], videos: Sequence[Path], root: Path, out: Path) -> str:
    """The report in Markdown, pictures and videos linked relative to ``out``'s folder."""

    def link(path: Path) -> str:
        return Path(os.path.relpath(path, out.parent)).as_posix()

    parts = [f"# {_TITLE}", _lead(sections)]
    for section in sections:
        parts.append(f"## {section.title}")
        if section.table is None:
            parts.append(f"Not measured here; `{section.command}` does so.")
            continue
        parts.append(results.markdown(section.table))
        parts.append(
            "\n".join(
                f"- **{'Holds' if v.holds else 'Does not hold'}.** {v.claim}: {v.found}." for v in section.verdicts
            )
        )
        if section.sentences:
            parts.append("\n".join(f"- {said}" for said in section.sentences))
        parts += [f"![{section.title}]({link(p)})" for p in (section.picture, section.courses) if p]
        parts.append(_source(section, root, str, "`{}`".format))
    parts += [
        "## Videos",
        "\n".join(f"- [{path.relative_to(root)}]({link(path)})" for path in videos) or "There are none.",
    ]
    return "\n\n".join(parts)


def _html_table(each: Table) -> str:
    def line(cells, tag):
        return "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells)

    rows = (
        f"<tr{' class=paper' if any('the paper' in cell for cell in cells) else ''}>{line(cells, 'td')}</tr>"
        for cells in each.lines
    )
    return (
        f'<div class="wide"><table><caption>{html.escape(each.caption)}</caption>'
        f"<tr>{line(each.headings, 'th')}</tr>{''.join(rows)}</table></div>"
    )


def _html_verdict(verdict: Verdict) -> str:
    mark = '<span class="yes">holds</span>' if verdict.holds else '<span class="no">does not</span>'
    return f"<li>{mark}{html.escape(verdict.claim)}: {html.escape(verdict.found)}.</li>"


def _data(path: Path, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


def _source(section: Section, root: Path, plain: Callable[[str], str], code: Callable[[str], str]) -> str:
    """Where a section's figures are from."""
    origin = section.provenance
    changes = " with uncommitted changes" if origin.get("uncommitted_changes") else ""
    file = str(section.source and section.source.relative_to(root))
    return (
        f"From {code(plain(file))}: {code(plain(origin['command']))}, "
        f"{plain(origin['date'])}, commit {plain(str(origin['commit'])[:12])}{changes}, {plain(origin['device'])}, "
        f"JAX {plain(origin['packages']['jax'])}."
    )


def write(folder: Path, out: Path) -> list[Path]:
    """Write the report on the results below ``folder`` to ``out`` (HTML), and beside it in Markdown; the paths written.

    Raises:
      UserError: there are no results, or the page cannot be written.
    """
    from fmpjax import runs

    sections = gather(folder)
    videos = sorted(folder.rglob("*.mp4"))
    markdown = out.with_suffix(".md")
    if out.suffix != ".html":
        raise UserError(f"--out {out}: expected a name that ends in .html")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        runs.write(out, page(sections, videos, folder))
        runs.write(markdown, text(sections, videos, folder, markdown))
    except OSError as error:
        raise UserError(f"{out} cannot be written: {error.strerror}") from None
    return [out, markdown]

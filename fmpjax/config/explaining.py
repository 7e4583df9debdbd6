"""Every setting explained, from where it is declared: for ``fmpjax settings`` and for docs/settings.md."""

import dataclasses
import difflib
import functools
import inspect
import re
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

from fmpjax.config.base import SOURCES, Section
from fmpjax.config.presets import DESCRIPTIONS, PRESETS, preset
from fmpjax.config.reading import described, flatten, types
from fmpjax.config.sections import Config
from fmpjax.errors import UserError


@dataclasses.dataclass(frozen=True)
class Setting:
    """What there is to know about one setting."""

    key: str
    expected: str  # values that it takes, in words
    meaning: str  # with unit and source
    values: Mapping[str, Any]  # by preset


@functools.cache
def settings() -> Mapping[str, Setting]:
    """All settings by key, in the order of the sections."""
    presets = {name: flatten(preset(name)) for name in reversed(tuple(PRESETS))}
    found = {}
    for key in flatten(Config()):
        section, _, field = key.rpartition(".")
        owner = type(getattr(Config(), section)) if section else Config
        values = {name: flat[key] for name, flat in presets.items()}
        found[key] = Setting(key, described(types(owner)[field]), _comments(owner)[field], values)
    return found


def text(name: str = "") -> str:
    """Settings for a terminal, of one section or one alone where it is named.

    Raises:
      UserError: there is no such section or setting.
    """
    chosen = [setting for key, setting in settings().items() if not name or key == name or key.startswith(f"{name}.")]
    if not chosen:
        close = difflib.get_close_matches(name, [*sections(), *settings()], n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"expected one of {', '.join(sections())}, or one setting"
        raise UserError(f"unknown section {name!r}: {hint}")
    blocks = [
        f"{setting.key} = {_differing(setting)}\n    {setting.meaning}\n    {setting.expected}" for setting in chosen
    ]
    return "\n".join([*blocks, "", textwrap.fill(f"Sources: {_legend()}.", 100), ""])


def markdown() -> str:
    """The page docs/settings.md."""
    lines = [
        "# Settings",
        "",
        "`--section.field VALUE` changes a setting in `fmpjax train` and `fmpjax pretrain`, and so does",
        "`--set section.field=value`. `fmpjax settings [SECTION]` explains it, and so does `--help`. This page is what",
        "`fmpjax settings --markdown` prints.",
        "",
        textwrap.fill(f"Letters in brackets name the source of a number: {_legend()}.", 120),
        "",
        *(f"- preset `{name}`: {words}" for name, words in DESCRIPTIONS.items()),
    ]
    for section, sentence in {"": "The run itself.", **sections()}.items():
        names = " | ".join(reversed(tuple(PRESETS)))
        lines += ["", f"## {section or 'run'}", "", sentence, "", f"| setting | {names} | meaning | values |"]
        lines += ["|" + "---|" * (len(PRESETS) + 3)]
        for setting in settings().values():
            if setting.key.rpartition(".")[0] == section:
                cells = [f"`{setting.key}`", *(f"`{shown(value)}`" for value in setting.values.values())]
                cells += [setting.meaning, setting.expected]
                lines.append("| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def sections() -> Mapping[str, str]:
    """The sections by name, each with the first sentence of what it is."""
    found = {field.name: getattr(Config(), field.name) for field in dataclasses.fields(Config)}
    return {name: type(value).__doc__ for name, value in found.items() if isinstance(value, Section)}


@functools.cache
def _comments(section: type) -> Mapping[str, str]:
    """The comment of each field, behind it or right above it."""
    found = {}
    for owner in reversed(section.__mro__):
        if not dataclasses.is_dataclass(owner):
            continue
        above = []
        for line in inspect.getsource(owner).splitlines():
            code, _, comment = line.partition("# ")
            if field := re.match(r"    (\w+): ", code):
                found[field[1]] = comment or " ".join(above)
            above = [*above, comment] if comment and not code.strip() else []
    return found


def shown(value: Any) -> str:
    """A value as the command line takes it."""
    if isinstance(value, tuple):
        return ",".join(map(shown, value))
    return str(value).lower() if isinstance(value, bool) else str(value) or '""'


def enumerated(names: Sequence[str]) -> str:
    """Names as a sentence lists them: "a, b and c"."""
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last


def _differing(setting: Setting) -> str:
    """The paper's value, and the presets that depart from it."""
    (_, common), *others = setting.values.items()
    differing: dict[str, list[str]] = {}
    for name, value in others:
        if value != common:
            differing.setdefault(shown(value), []).append(name)
    departures = ", ".join(f"{value} in {enumerated(names)}" for value, names in differing.items())
    return shown(common) + (f" ({departures})" if departures else "")


def _legend() -> str:
    return ", ".join(f"[{letter}] {source}" for letter, source in SOURCES.items())

"""Settings as options of a command: ``--section.field VALUE`` for each of them, and ``--set section.field=value``."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import tyro

from fmpjax import config as configuration
from fmpjax.config import explaining
from fmpjax.errors import UserError
from fmpjax.shell import default


@functools.cache
def _preset(name: str) -> dict[str, Any]:
    """The settings of a preset by their keys. Every start of the program asks for each of them several times."""
    return configuration.flatten(configuration.preset(name))


def preset_default(key: str) -> Any:
    """For ``Annotated``: the default of an option that overrides a setting, which may depend on the preset."""
    return default(_default(key))


def _default(key: str) -> str:
    presets: dict[str, list[str]] = {}
    for name in configuration.PRESETS:
        value = _preset(name)[key]
        number = isinstance(value, int) and not isinstance(value, bool)
        presets.setdefault(f"{value:,}" if number else explaining.shown(value), []).append(name)
    if len(presets) == 1:
        return next(iter(presets))
    return ", ".join(f"{value} in {explaining.enumerated(names)}" for value, names in presets.items())


@functools.cache
def options(*named: str) -> type:
    """A dataclass whose fields are the settings, all of them None until they are given as texts.

    Each option is explained by its setting's comment. `changes` reads an instance.

    Args:
      named: settings that the command has under names of its own.
    """
    sections: dict[str, list[tuple[str, Any, None]]] = {}
    for key, setting in explaining.settings().items():
        section, _, field = key.rpartition(".")
        if key not in named:
            meaning = f"{setting.meaning}; {setting.expected}."
            told = tyro.conf.arg(help=meaning, metavar="VALUE", help_behavior_hint=f"(default: {_default(key)})")
            sections.setdefault(section, []).append((field, Annotated[str | None, told], None))
    fields: list[tuple[str, Any, Any]] = list(sections.pop("", []))
    for name, sentence in explaining.sections().items():
        group = dataclasses.make_dataclass(name, sections[name], frozen=True, namespace={"__doc__": sentence})
        fields.append((name, group, group()))
    return dataclasses.make_dataclass("Settings", fields, frozen=True)


def changes(given: Any, items: Sequence[str], named: Mapping[str, object]) -> dict[str, object]:
    """Settings by their keys, from all that a command line can say of them.

    Args:
      given: an instance of a class of `options`.
      items: of ``--set``, as ``section.field=value``.
      named: settings that the command has options for by other names; those that are None were not given.

    Raises:
      UserError: an item is not of that form, or a setting is given in two of these ways with different values.
    """
    found: dict[str, object] = {key: value for key, value in named.items() if value is not None}
    listed = dict(map(_item, items))  # of two for one setting the last counts
    for key, value in [*_given(given), *listed.items()]:
        if str(found.setdefault(key, value)) != value:
            raise UserError(f"setting {key} is given in two ways, as {found[key]} and as {value}: expected one of them")
    return found


def _given(given: Any, section: str = "") -> list[tuple[str, str]]:
    found = []
    for field in dataclasses.fields(given):
        value = getattr(given, field.name)
        if dataclasses.is_dataclass(value):
            found += _given(value, f"{field.name}.")
        elif value is not None:
            found.append((section + field.name, value))
    return found


def _item(item: str) -> tuple[str, str]:
    key, equals, value = item.partition("=")
    if not equals or key == "preset":
        raise UserError(f"--set {item!r}: expected section.field=value")
    return key, value

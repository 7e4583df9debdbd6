"""Settings from texts, files and Python values, checked by the types of their fields; and back to JSON."""

import dataclasses
import difflib
import functools
import json
import math
import os
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec import inspect as kinds

from fmpjax import jsons
from fmpjax.config.base import Section
from fmpjax.config.sections import Config
from fmpjax.errors import UserError


@functools.cache
def types(section: type) -> Mapping[str, Any]:
    """The annotated type of each field of a section or of `Config`."""
    return typing.get_type_hints(section, include_extras=True)


def with_changes(config: Config, changes: Mapping[str, Any]) -> Config:
    """``config`` with ``section.field`` or ``field`` keys replaced; strings are read as the field's type.

    Values are checked one by one; `validate` checks whether they go together.

    Raises:
      UserError: unknown field, or a value that is not of its type or outside its bounds.
    """
    for key, value in changes.items():
        section, _, field = key.rpartition(".")
        target: Any = getattr(config, section, None) if section else config
        names = [f.name for f in dataclasses.fields(target)] if isinstance(target, Section) else []
        if field not in names or isinstance(getattr(target, field), Section):
            close = difflib.get_close_matches(key, list(flatten(config)), n=1)
            hint = f"did you mean {close[0]!r}?" if close else "see `fmpjax settings` for all of them"
            raise UserError(f"unknown setting {key!r}: {hint}")
        target = dataclasses.replace(target, **{field: _convert(key, value, types(type(target))[field])})
        config = dataclasses.replace(config, **{section: target}) if section else target
    return config


def _convert(key: str, value: Any, annotation: Any) -> Any:
    kind = kinds.type_info(annotation)
    try:
        converted = msgspec.convert(_plain(value, kind), annotation, strict=False)
        numbers = converted if isinstance(converted, tuple) else (converted,)
        if not all(math.isfinite(number) for number in numbers if isinstance(number, float)):
            raise ValueError
        return converted
    except ValueError:  # msgspec's error is one
        raise UserError(f"setting {key} is {value!r}: expected {described(annotation)}") from None


def _plain(value: Any, kind: kinds.Type) -> Any:
    """``value`` as msgspec takes it: no NumPy, no paths, and a string's numbers bare."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, os.PathLike):
        value = os.fspath(value)
    if isinstance(value, str) and isinstance(kind, kinds.IntType | kinds.FloatType):
        value = value.strip().replace("_", "")
    if isinstance(value, str) and isinstance(kind, kinds.VarTupleType):
        value = [_plain(item, kind.item_type) for item in value.strip("()[] ").split(",") if item.strip()]
    return value


def described(annotation: Any) -> str:
    """What values a field's type takes, in words: "a whole number of at least 1"."""
    kind = kinds.type_info(annotation)
    match kind:
        case kinds.LiteralType():
            return f"one of {', '.join(map(str, kind.values))}"
        case kinds.BoolType():
            return "true or false"
        case kinds.VarTupleType(item_type=kinds.IntType() | kinds.FloatType() as item):
            least = "one or more " if kind.min_length else ""
            return f"{least}{_number(item)}s{_bounds(item)}, with commas between"
        case kinds.IntType() | kinds.FloatType():
            return f"a {_number(kind)}{_bounds(kind)}"
    return "text"


def _number(kind: kinds.IntType | kinds.FloatType) -> str:
    return "whole number" if isinstance(kind, kinds.IntType) else "number"


def _bounds(kind: kinds.IntType | kinds.FloatType) -> str:
    words = {"gt": "above", "ge": "of at least", "lt": "below", "le": "at most"}
    stated = [f" {word} {getattr(kind, name):,}" for name, word in words.items() if getattr(kind, name) is not None]
    return " and".join(stated)


def flatten(config: Config) -> dict[str, Any]:
    """All settings by ``section.field`` key."""
    flat = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if isinstance(value, Section):
            flat |= {f"{field.name}.{f.name}": getattr(value, f.name) for f in dataclasses.fields(value)}
        else:
            flat[field.name] = value
    return flat


def validate(config: Config) -> Config:
    """The configuration itself.

    Raises:
      UserError: a value is not of its type or outside its bounds, or values do not go together.
    """
    with_changes(config, flatten(config))
    config.check()
    return config


def to_json(config: Config) -> str:
    """The settings as a flat JSON object."""
    return jsons.dumps(flatten(config))


# What settings were before they existed, where that is not the default: what an older file without them means.
_BEFORE: dict[str, Any] = {
    "precision": "default",
    "env.demonstration_parts": 1,
    "env.early_frames": False,
    "evaluation_noise": (0.0,),
}


def from_json(text: str) -> Config:
    """The configuration that `to_json` wrote.

    Raises:
      json.JSONDecodeError: the text is no JSON object.
      UserError: an unknown setting, or a value that it cannot have.
    """
    settings = json.loads(text)
    if not isinstance(settings, dict):
        raise json.JSONDecodeError("no object", text, 0)
    return validate(with_changes(Config(), {**_BEFORE, **settings}))


def read(path: Path) -> Config:
    """The configuration in a run's ``config.json``.

    Raises:
      UserError: the file holds none.
    """
    try:
        return from_json(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError):
        raise UserError(f"{path} is not valid JSON: expected a run's configuration") from None

"""Text files: written whole or not at all, and without this machine's folders in them."""

import json
import os
from collections.abc import Iterable
from pathlib import Path


def write(path: Path, text: str) -> None:
    """Write a file whole or not at all."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text + "\n")
    os.replace(partial, path)


def without_places(text: str, places: Iterable[Path | str]) -> str:
    """JSON ``text`` with the files and folders of this machine cut to their names."""
    for place in sorted(map(str, places), key=len, reverse=True):
        name = Path(place).name or place  # "." has none
        text = text.replace(json.dumps(place)[1:-1], json.dumps(name)[1:-1])
    return text

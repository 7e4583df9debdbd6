"""Rules of the house that a machine can check: the length of files and functions."""

import ast

from tests.helpers import ROOT

MOST_LINES = {"file": 400, "function": 60}


def long(path: str, text: str) -> list[str]:
    """The file and its functions that are too long, as ``path`` and ``path:function``.

    A line ``# long: reason`` allows a file that has it at its margin, and a function that has it inside.
    """
    lines = text.splitlines()
    reasoned = [i for i, line in enumerate(lines, 1) if line.lstrip().startswith("# long: ")]
    found = []
    if len(lines) > MOST_LINES["file"] and not any(lines[i - 1].startswith("#") for i in reasoned):
        found.append(path)
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        size = node.end_lineno - node.lineno + 1
        if size > MOST_LINES["function"] and not any(node.lineno < i <= node.end_lineno for i in reasoned):
            found.append(f"{path}:{node.name}")
    return found


def test_files_and_functions_are_short():
    """The package and the benchmarks; tests are lists of cases."""
    found = set()
    for folder in ("fmpjax", "benchmarks"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            found.update(long(path.relative_to(ROOT).as_posix(), path.read_text()))
    assert not found, "split it, or give the reason in a line `# long: reason`"


def test_what_is_too_long_is_found():
    body = "    x = 1\n"
    assert long("a.py", "x = 1\n" * 400) == [] and long("a.py", "x = 1\n" * 401) == ["a.py"]
    assert long("a.py", "# long: a table\n" + "x = 1\n" * 400) == []
    assert long("a.py", "def f():\n" + body * 59) == [] and long("a.py", "def f():\n" + body * 60) == ["a.py:f"]
    assert long("a.py", "def f():\n    # long: reason\n" + body * 60) == []
    assert long("a.py", "    # long: elsewhere\ndef f():\n".lstrip() + body * 60) == ["a.py:f"]

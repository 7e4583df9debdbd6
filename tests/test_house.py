"""Rules of the house that a machine can check: the length of files and functions, spelling, the table of modules."""

import ast
import re
from pathlib import Path

from tests.helpers import ROOT

MOST_LINES = {"file": 400, "function": 60}
SPELLED = ("fmpjax", "benchmarks", "tests", "examples", "docs", "experiments", "robots", "motions")  # folders
BRITISH = re.compile(
    r"centre|colour|favour|behaviour|neighbour|honour|metre\b|catalogue|licence|analysed|analysing|towards|\bgrey\b"
    r"|(?:model|label|travel|cancel|signal)l(?:ed|ing)"
    r"|(?:normal|general|optim|standard|regular|initial|random|penal|summar|organ|recogn|visual|minim|maxim|quant"
    r"|parametr|discret|serial|synchron|linear|emphas|util)is(?:e|ing|ation)",
    re.IGNORECASE,
)


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


def british(text: str) -> list[str]:
    """The British spellings in a text, in its order."""
    return BRITISH.findall(text)


def test_spelling_is_american():
    texts = list(ROOT.glob("*.md"))
    for folder in SPELLED:
        for suffix in ("py", "md", "toml", "js", "html", "ipynb"):
            texts += (ROOT / folder).rglob(f"*.{suffix}")
    found = {path.relative_to(ROOT).as_posix(): british(path.read_text()) for path in texts if path != Path(__file__)}
    assert len(found) > 200
    assert {path: words for path, words in found.items() if words} == {}


def test_british_spelling_is_found():
    assert british("arm_centre, millimetre, normalised, Optimisation, labelled") == [
        "centre",
        "metre",
        "normalise",
        "Optimisation",
        "labelled",
    ]
    assert british("arm_center, parameters, geometry, otherwise, raised, analyses of noise") == []


def imported(module: Path) -> set[str]:
    """The modules of the package that a file, or the files of a folder, import, by their first name."""
    found = set()
    for path in [module] if module.is_file() else module.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module == "fmpjax":
                found.update(name.name for name in node.names if name.name != "__version__")
            elif isinstance(node, ast.ImportFrom):
                found.update(re.findall(r"^fmpjax\.(\w+)", node.module or ""))
            elif isinstance(node, ast.Import):
                found.update(word for name in node.names for word in re.findall(r"^fmpjax\.(\w+)", name.name))
    return found - {module.stem}


def test_the_table_of_modules_says_what_each_imports():
    """The last column of docs/architecture.md, where it names modules."""
    text = (ROOT / "docs" / "architecture.md").read_text()
    said = dict(re.findall(r"^\| `(\w+(?:\.py|/))` \|.*\| ([^|]+) \|$", text, re.MULTILINE))
    there = {path.name for path in (ROOT / "fmpjax").glob("*.py")} - {"__init__.py"}
    there |= {f"{path.parent.name}/" for path in (ROOT / "fmpjax").glob("*/__init__.py")}
    assert set(said) == there
    listed = {name: words for name, words in said.items() if not re.search("all above|modules below", words)}
    expected = {name: set(re.findall(r"\w+", words)) for name, words in listed.items()}
    assert {name: imported(ROOT / "fmpjax" / name) for name in listed} == expected

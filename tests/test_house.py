"""Rules of the house that a machine can check.

The length of files and functions, spelling, the table of modules, names that shadow an import, private names, helpers.
"""

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


def nodes(folder: str):
    """Each file of a folder, and its syntax tree."""
    for path in sorted((ROOT / folder).rglob("*.py")):
        yield path.relative_to(ROOT).as_posix(), ast.parse(path.read_text())


def shadows(tree: ast.Module) -> list[str]:
    """Names that a file imports at its top and that one of its functions takes or assigns, in which they mean two."""
    imports = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
    known = {(name.asname or name.name).split(".")[0] for node in imports for name in node.names}
    found = set()
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            for node in ast.walk(function):
                if isinstance(node, ast.arg):
                    found.add(node.arg)
                elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                    found.add(node.id)
    return sorted(found & known)


def test_no_name_shadows_an_import():
    found = {path: shadows(tree) for folder in ("fmpjax", "benchmarks", "examples") for path, tree in nodes(folder)}
    assert len(found) > 150
    assert {path: names for path, names in found.items() if names} == {}


def test_a_name_that_shadows_an_import_is_found():
    taken = "from a import metrics, runs as made\nimport b.c\ndef f(metrics):\n    made = b = 1\n    other = 2\n"
    assert shadows(ast.parse(taken)) == ["b", "made", "metrics"]
    assert shadows(ast.parse("import metrics\nmetrics = metrics.f\ndef f(): return metrics")) == []


def private(tree: ast.Module) -> list[str]:
    """Names with a leading underscore that a file takes from elsewhere."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            found += [name.name for name in node.names]
        elif isinstance(node, ast.Attribute) and getattr(node.value, "id", None) not in ("self", "os"):
            found.append(node.attr)
    return sorted({name for name in found if re.match(r"_[a-z]", name)} - {"_asdict", "_fields", "_replace"})


def test_benchmarks_and_examples_use_nothing_private():
    found = {path: private(tree) for folder in ("benchmarks", "examples") for path, tree in nodes(folder)}
    assert len(found) > 10
    assert {path: names for path, names in found.items() if names} == {}


def test_a_private_name_is_found():
    assert private(ast.parse("from a import _b\nc = d.e._f\nself._g = h._replace(i=1)")) == ["_b", "_f"]


def test_helpers_are_not_in_test_files():
    """What several tests need is in tests/helpers.py."""
    taken = {
        f"{path}: {node.module}"
        for path, tree in nodes("tests")
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and re.search(r"^tests\..*\btest_", node.module or "")
    }
    assert taken == set()

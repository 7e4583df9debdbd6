"""What stands beside the package: requirements, Makefile, examples in the documents."""

import doctest
import importlib
import os
import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

import fmpjax
from tests.helpers import ROOT

IMPORTED_AS = {
    "huggingface-hub": "huggingface_hub", "imageio-ffmpeg": "imageio_ffmpeg", "mujoco-mjx": "mujoco",
    "orbax-checkpoint": "orbax", "ott-jax": "ott", "pillow": "PIL",
}  # fmt: skip


def _name(requirement: str) -> str:
    return re.match(r"[A-Za-z0-9-]+", requirement)[0].lower()


def test_every_requirement_is_imported_and_pinned():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pinned = {line.partition("==")[0] for line in (ROOT / "constraints.txt").read_text().splitlines()}
    code = "\n".join(path.read_text() for path in (ROOT / "fmpjax").rglob("*.py"))
    optional = project["optional-dependencies"]
    for requirement in [
        *project["dependencies"],
        *(r for extra in ("viz", "retarget", "deploy", "play", "hub", "benchmark") for r in optional[extra]),
    ]:
        name = _name(requirement)
        module = IMPORTED_AS.get(name, re.match(r"[A-Za-z0-9-]+", requirement)[0])
        imported = re.search(rf"^\s*(import|from) {module}\b|import_module\(\"{module}\"\)", code, re.MULTILINE)
        assert imported, name
        assert name in pinned, name
    assert {_name(requirement) for extra in ("dev", "docs") for requirement in optional[extra]} <= pinned


def test_a_citation_names_the_version():
    assert re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)[1] == fmpjax.__version__


def test_the_oldest_versions_are_those_that_the_project_declares():
    """What `make test-oldest` installs: of each requirement the least version that is allowed."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    optional = project["optional-dependencies"]
    oldest = dict(
        line.split("==") for line in (ROOT / "constraints-oldest.txt").read_text().splitlines() if "==" in line
    )
    for requirement in [*project["dependencies"], *optional["viz"], *optional["retarget"]]:
        least = re.search(r">=([0-9.]+)", requirement)[1].split(".")
        pinned = oldest[_name(requirement)].split(".")
        assert pinned == least + ["0"] * (len(pinned) - len(least)), requirement


def _examples():
    """The modules whose docstrings have examples."""
    for path in sorted((ROOT / "fmpjax").rglob("*.py")):
        if re.search(r"^\s*>>> ", path.read_text(), re.MULTILINE):
            yield ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


@pytest.mark.parametrize("name", _examples())
def test_the_examples_of_docstrings_are_right(name):
    found = doctest.testmod(importlib.import_module(name))
    assert found.attempted and not found.failed


def _blocks():
    """The README's examples in Python; the next one goes on with what one leaves."""
    return re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(), re.MULTILINE | re.DOTALL)


@pytest.mark.slow
def test_the_examples_of_the_readme_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names, blocks = {}, _blocks()
    assert blocks
    for block in blocks:
        exec(compile(block, "README.md", "exec"), names)


# --- make ------------------------------------------------------------------------------------------------------------

needs_make = pytest.mark.skipif(not shutil.which("make"), reason="no make here")


def _environment() -> dict[str, str]:
    """This process's, less what make tells its children: these tests may be run by make themselves."""
    own = ("MAKEFLAGS", "MAKELEVEL", "MAKEOVERRIDES", "MFLAGS")
    return {name: value for name, value in os.environ.items() if name not in own}


def _make(*arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        ["make", "--dry-run", *arguments], cwd=ROOT, env=_environment(), capture_output=True, text=True, timeout=60
    )


@needs_make
@pytest.mark.parametrize(
    ("arguments", "unknown"),
    [
        (("train", "PRESETT=smoke"), r"PRESETT, perhaps PRESET: make train takes METHOD RESET PRESET .*"),
        (("train", "preset=smoke"), r"preset, perhaps PRESET: make train takes .*"),
        (("train", "OPTIMIZER=adam"), r"OPTIMIZER: make train takes .*"),
        (("evaluate", "RUN=a", "PRESET=smoke"), r"PRESET: make evaluate takes RUN ARGS .*"),
        (("PRESET=smoke",), r"PRESET: make help takes .*"),
        (
            ("train", "JAX_PLATFORMS=cpu"),
            r"JAX_PLATFORMS: .*; as an environment variable it stands before make: JAX_PLATFORMS=\.\.\. make train",
        ),
        *(((target, "XYZ=1"), rf"XYZ: make {target} takes .*")
          for target in ("render", "test", "test-fast", "test-oldest", "coverage", "check", "docs", "format", "build",
                         "clean", "help")),
    ],
)  # fmt: skip
def test_make_refuses_an_unknown_variable(arguments, unknown):
    done = _make(*arguments)
    assert done.returncode == 2 and done.stdout == ""
    assert re.fullmatch(rf"Makefile:\d+: \*\*\* unknown variable {unknown}\.  Stop\.\n", done.stderr), done.stderr


@needs_make
def test_make_takes_its_variables():
    done = _make("train", "METHOD=amp", "PRESET=smoke", "SEEDS=2", "RESUME=1", "ARGS=--set ppo.discount=0.9")
    assert done.returncode == 0, done.stderr
    assert "train --method 'amp' --preset 'smoke' --seeds '2' --resume --set ppo.discount=0.9" in done.stdout
    assert _make("test", "WORKERS=3", "ARGS=tests/test_project.py").returncode == 0
    assert _make("evaluate", "RUN=runs/a b").returncode == 0
    assert _make("check", "test", "WORKERS=3").returncode == 0  # what one of several targets takes
    fresh = _make("clean", "check", "UV=uv", "VENV=nowhere").stdout
    assert "uv venv --quiet --seed --python '>=3.11,<3.14' nowhere" in fresh


@needs_make
def test_the_oldest_versions_are_tested_in_an_environment_of_their_own():
    done = _make("test-oldest", "UV=uv", "ARGS=-x")
    assert done.returncode == 0, done.stderr
    assert ".venv-oldest/bin/python -m pytest -m 'not slow' -x" in done.stdout
    assert "-c constraints-oldest.txt" in done.stdout or (ROOT / ".venv-oldest/.ready").exists()


@needs_make
@pytest.mark.skipif(not (ROOT / ".ci").is_dir(), reason="the source archive leaves it out")
def test_the_check_of_a_submission_lints_builds_the_site_and_tests_and_installs_once(tmp_path):
    """On a machine that has nothing: `make` prints what it would do."""
    stub = tmp_path / "make"
    stub.write_text(f'#!/bin/sh\nexec {shutil.which("make")} --dry-run VENV=nowhere UV=uv "$@"\n')
    stub.chmod(0o755)
    environment = _environment()
    environment["PATH"] = f"{tmp_path}{os.pathsep}{environment['PATH']}"
    done = subprocess.run([ROOT / ".ci" / "run"], env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count(".[dev,viz,retarget]") == 1
    said = (".[dev,viz,retarget]", "nowhere/bin/ruff check", "nowhere/bin/mkdocs build", "-m pytest")
    places = [done.stdout.index(words) for words in said]
    assert places == sorted(places)


def _pages():
    return [
        page for where in ("*.md", "docs/*.md", "experiments/**/*.md", "robots/**/*.md") for page in ROOT.glob(where)
    ]


def _headings(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub makes them."""
    titles = re.findall(r"^#+ (.*)$", page.read_text(), flags=re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", _pages(), ids=lambda page: str(page.relative_to(ROOT)))
def test_the_links_of_the_pages_lead_somewhere(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.S)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        path, _, anchor = link.partition("#")
        if re.match(r"[a-z]+:", link):
            continue
        target = page.parent / path if path else page
        assert target.exists(), link
        assert not anchor or target.suffix != ".md" or anchor in _headings(target), link


# --- benchmarks/accelerator.sh ---------------------------------------------------------------------------------------

needs_coreutils = pytest.mark.skipif(not (shutil.which("timeout") and shutil.which("split")), reason="no timeout here")


def _accelerator(folder: Path, *arguments: object) -> subprocess.CompletedProcess:
    """The script with an interpreter that says what it is asked for and makes a run's configuration."""
    python = folder / "python"
    python.write_text('#!/bin/sh\necho "asked: $*"\n[ "$3" != train ] || echo {} > "$MADE/config.json"\n')
    python.chmod(0o755)
    environment = os.environ | {"PYTHON": str(python), "MADE": str(folder / "out" / "run")}
    command = ["bash", str(ROOT / "benchmarks" / "accelerator.sh"), *map(str, arguments)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)


@needs_coreutils
def test_an_accelerator_is_measured_and_trained_on_in_pieces(tmp_path):
    """A step's failure does not end it; the second piece of a training resumes the first."""
    out = tmp_path / "out"
    (out / "run").mkdir(parents=True)
    measured = _accelerator(tmp_path, "measure", out)
    assert measured.returncode == 0, measured.stderr
    asked = re.findall(r"^asked: benchmarks/(\w+)\.py", measured.stdout, re.MULTILINE)
    assert asked == ["physics"] * 6 + ["fit", "throughput"]
    assert {path.stem for path in out.glob("*.log")} >= {"machine", "physics-mjx-warp-4096", "fit", "parts"}
    first, second = (_accelerator(tmp_path, "train", out, 30, "--motion", "clip.csv").stdout for _ in range(2))
    assert f"train --preset paper --reset fixed --method fmp --run {out}/run --motion clip.csv" in first
    assert f"train --resume --run {out}/run --motion clip.csv" in second
    assert _accelerator(tmp_path, "train", out).returncode == 2


@needs_coreutils
def test_a_packed_run_has_its_newest_state_and_its_best(tmp_path):
    out = tmp_path / "out"
    for name in ("config.json", "best/7/state", "checkpoints/9/state", "checkpoints/10/state"):
        (out / "run" / name).parent.mkdir(parents=True, exist_ok=True)
        (out / "run" / name).write_text(name)
    assert _accelerator(tmp_path, "pack", out).returncode == 0
    assert _accelerator(tmp_path, "unpack", out / "packed", tmp_path / "there").returncode == 0
    run = tmp_path / "there" / "run"
    files = {path.relative_to(run).as_posix() for path in run.rglob("*") if path.is_file()}
    assert files == {"config.json", "best/7/state", "checkpoints/10/state"}

"""The wheel as a user gets it: what it holds, and that it works away from the checkout."""

import os
import subprocess
import sys
import zipfile

import pytest

from tests.helpers import ROOT

pytestmark = pytest.mark.slow


def run(*command, **options):
    """Run a command and give what it printed; its own words if it fails."""
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, built as `make build` does: from the source archive, so that what this lacks shows too."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--outdir", folder, ROOT)
    (path,) = folder.glob("fmpjax-*.whl")
    return path


@pytest.mark.parametrize("kind", ["robots", "motions"])
def test_wheel_holds_the_resources(wheel, kind):
    shipped = {path.relative_to(ROOT).as_posix() for path in (ROOT / kind).rglob("*") if path.is_file()}
    assert shipped
    prefix = "fmpjax/_resources/"
    names = {name.removeprefix(prefix) for name in zipfile.ZipFile(wheel).namelist() if name.startswith(prefix + kind)}
    assert names == shipped


def test_wheel_holds_the_package_and_nothing_beside_it(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0].partition("-")[0] for name in names} == {"fmpjax"}
    modules = {path.relative_to(ROOT).as_posix() for path in (ROOT / "fmpjax").rglob("*.py")}
    assert modules == {name for name in names if name.endswith(".py")}
    assert "fmpjax/py.typed" in names
    page = ROOT / "fmpjax" / "deploy" / "page"
    assert {path.relative_to(ROOT).as_posix() for path in page.iterdir()} <= set(names)


def test_installed_wheel_loads_the_robot_away_from_the_checkout(wheel, tmp_path):
    target, elsewhere = tmp_path / "site", tmp_path / "elsewhere"
    elsewhere.mkdir()
    run(sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", target, wheel)
    code = (
        "import fmpjax.resources, fmpjax.robots as robots;"
        "print(fmpjax.resources.folder('robots'), fmpjax.resources.folder('motions').is_dir());"
        "print(robots.load('unitree_g1').joint_count)"
    )
    printed = run(sys.executable, "-c", code, cwd=elsewhere, env=os.environ | {"PYTHONPATH": str(target)})
    # The checkout, which an editable install puts on the path as well, is not what is read.
    assert printed.splitlines()[-2:] == [f"{target / 'fmpjax' / '_resources' / 'robots'} True", "29"]

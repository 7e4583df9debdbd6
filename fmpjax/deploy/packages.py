"""Programs of others that a page needs. They come from npm when a page is written; fmpjax ships none of them."""

import base64
import hashlib
import importlib.metadata
import os
import shutil
import subprocess
import sysconfig
import tarfile
import tempfile
from pathlib import Path
from typing import NamedTuple

from fmpjax.errors import UserError

_SECONDS = 600  # that npm may take for one package


class Package(NamedTuple):
    """One release of an npm package, and what a page takes of it."""

    name: str
    version: str
    sha512: str  # of its archive, base64 as npm writes it
    license: str
    licensed_by: str | None  # the Python distribution that has the text of the license where the archive has none
    files: dict[str, str]  # name in the page: name in the archive


PACKAGES = {
    "mujoco": Package(
        "@mujoco/mujoco",
        "3.14.0",
        "WPUYidu4Fx8+uM4hQv80SOA0ifpWGrsNJguKs8JBV8SCTxjKQ2/rqsh880nUH0/Vwa8vuefghvCQkkoed3bkUg==",
        "Apache-2.0",
        "mujoco",
        {"mujoco.js": "mujoco.js", "mujoco.wasm": "mujoco.wasm"},
    ),
    "onnxruntime-web": Package(
        "onnxruntime-web",
        "1.30.0",
        "q0y+JrrtukXSzsBWEMccVfqX25LRmosXHF+CaRJmg8pZClzcV7svNc4rKY3jL02Vb7QmRMDs1SigqR4CXAfKYQ==",
        "MIT",
        "onnxruntime",
        # Many file servers do not know the ending .mjs.
        {"ort.js": "dist/ort.wasm.bundle.min.mjs", "ort.wasm": "dist/ort-wasm-simd-threaded.wasm"},
    ),
    "three": Package(
        "three",
        "0.187.0",
        "Qiu7R+Cmh8CstZsY1uJOSWnVlfo7ZtNLV7mF8Jltk3LB3AtDu9cRZlcnRKkAk8Y4z6KKw35z7Y7Urd7jWY8etA==",
        "MIT",
        None,
        {
            "three.module.js": "build/three.module.js",
            "three.core.js": "build/three.core.js",
            "OrbitControls.js": "examples/jsm/controls/OrbitControls.js",
            "LICENSE": "LICENSE",
        },
    ),
}


def collect() -> dict[str, bytes]:
    """The files of all packages, and their licenses, by their names in a page such as ``lib/three/LICENSE``.

    Raises:
      UserError: npm is missing, or cannot get a package, or a package is not the one that is expected.
    """
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for short, package in PACKAGES.items():
            archive = fetch(package, Path(folder))
            check(package, archive)
            files = read(package, archive)
            if package.licensed_by is not None:
                files |= _licenses(package.licensed_by)
            found |= {f"lib/{short}/{name}": content for name, content in files.items()}
    lines = [f"- {p.name} {p.version}, {p.license}: lib/{short}" for short, p in PACKAGES.items()]
    found["lib/README.md"] = ("Unchanged files of these npm packages:\n\n" + "\n".join(lines) + "\n").encode()
    return found


def fetch(package: Package, folder: Path) -> Path:
    """Let npm put a package's archive into a ``folder``; its path.

    Raises:
      UserError: npm is missing or fails.
    """
    # Where the extra `web` puts npm, and then anywhere.
    npm = shutil.which("npm", path=os.pathsep.join([sysconfig.get_path("scripts"), os.environ.get("PATH", "")]))
    if npm is None:
        raise UserError("--web needs npm, which is not installed: install the extra fmpjax[web], or Node.js")
    wanted = f"{package.name}@{package.version}"
    place = Path(tempfile.mkdtemp(dir=folder))
    words = [npm, "pack", wanted, "--pack-destination", str(place), "--ignore-scripts", "--prefer-offline"]
    words += ["--loglevel=error"]
    try:
        done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=_SECONDS)
    except subprocess.TimeoutExpired:
        raise UserError(f"npm took more than {_SECONDS} s for {wanted}: expected a faster connection") from None
    archives = list(place.glob("*.tgz"))
    if done.returncode or len(archives) != 1:
        said = (done.stderr.strip() or done.stdout.strip() or "it says nothing").splitlines()[0]
        raise UserError(f"npm cannot get {wanted} ({said}): expected a connection to its registry, or npm's own cache")
    return archives[0]


def check(package: Package, archive: Path) -> None:
    """Refuse an archive that is not the one that this program was written for.

    Raises:
      UserError: it is another one.
    """
    found = base64.b64encode(hashlib.sha512(archive.read_bytes()).digest()).decode()
    if found != package.sha512:
        raise UserError(
            f"{package.name} {package.version} has the SHA-512 {found[:12]}...: expected {package.sha512[:12]}..."
        )


def read(package: Package, archive: Path) -> dict[str, bytes]:
    """What a page takes of a package's archive; no path in the archive is ever written to."""
    with tarfile.open(archive) as opened:
        found = {}
        for name, inside in package.files.items():
            file = opened.extractfile(f"package/{inside}")
            assert file is not None, inside  # the archive is the expected one
            found[name] = file.read()
        return found


def _licenses(distribution: str) -> dict[str, bytes]:
    """License and notices of an installed Python package."""
    files = importlib.metadata.files(distribution) or []
    texts = [file for file in files if file.name.startswith(("LICENSE", "ThirdPartyNotices"))]
    return {file.name: Path(str(file.locate())).read_bytes() for file in texts}

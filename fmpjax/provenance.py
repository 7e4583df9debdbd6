"""Where a result comes from: command, commit, versions and machine of this process."""

import importlib.metadata
import platform
import shlex
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import jax

from fmpjax import shell
from fmpjax.machine import cores, processor

_PACKAGES = "jax jaxlib mujoco mujoco-mjx brax flax optax ott-jax orbax-checkpoint numpy".split()


def provenance() -> dict[str, object]:
    """Command, commit, versions and machine of this process."""
    here = Path(__file__).parent

    def git(*arguments: str) -> str | None:
        # An installed wheel may be inside another repository.
        if not (here.parent / "pyproject.toml").exists():
            return None
        try:
            done = subprocess.run(["git", *arguments], cwd=here, capture_output=True, text=True, timeout=10, check=True)
            return done.stdout.strip()
        except (OSError, subprocess.SubprocessError):
            return None

    changes = git("status", "--porcelain", "--untracked-files=no")
    return {
        "command": f"{shell.program()} {shlex.join(sys.argv[1:])}",
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": git("rev-parse", "HEAD"),
        "uncommitted_changes": None if changes is None else bool(changes),
        "python": platform.python_version(),
        "packages": {name: importlib.metadata.version(name) for name in _PACKAGES},
        "device": machine(),
        "processor": processor(),
        "cores": cores(),
    }


def machine() -> str:
    """The device that JAX computes on, in words."""
    device = jax.devices()[0]
    return f"{cores()} CPU cores" if device.platform == "cpu" else device.device_kind

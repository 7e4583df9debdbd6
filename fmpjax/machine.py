"""What this machine has and can do: cores, memory, systems that the package runs on."""

import contextlib
import hashlib
import io
import os
import platform
import sys
from pathlib import Path

_CGROUPS = "/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"  # version 2, version 1


def unsupported() -> str | None:
    """A sentence where the package does not run on this system, else None."""
    if sys.platform == "win32":
        return "Windows is not supported: use Linux, macOS or WSL (Windows Subsystem for Linux)"
    return None


def cores() -> int:
    """Processor cores that this process may use."""
    if hasattr(os, "process_cpu_count"):  # Python 3.13
        return os.process_cpu_count() or 1
    if hasattr(os, "sched_getaffinity"):  # Linux
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def memory() -> int | None:
    """Bytes of main memory that this process may use, its container's where that has a limit; None if unknown."""
    found = []
    with contextlib.suppress(AttributeError, ValueError, OSError):
        found.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    for path in _CGROUPS:
        with contextlib.suppress(OSError, ValueError):  # "max" is no number
            found.append(int(Path(path).read_text()))
    return min((size for size in found if size > 0), default=None)


def keep_compiled() -> None:
    """Have JAX keep compiled programs in the user's cache folder, 1 GiB at most, so that a second run starts at once.

    ``JAX_COMPILATION_CACHE_DIR`` names another folder, or none where it is empty. Machine code is of one kind of
    processor, so each has its own folder. Runs may share it.
    """
    import jax

    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    folder = cache_folder("compiled", hashlib.sha256(_processor().encode()).hexdigest()[:12])
    if folder is None:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_compilation_cache_max_size", 2**30)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def cache_folder(*names: str) -> Path | None:
    """A folder, made where it is not there, below the user's cache; None without a home, or one that can be written."""
    try:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folder = base.joinpath("fmpjax", *names)
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):
        return None
    return folder


def processor() -> str:
    """The name of the processor, as far as the system knows it."""
    named = (line.partition(":")[2].strip() for line in _cpuinfo() if line.startswith("model name"))
    return next(named, "") or platform.processor() or platform.machine()


def _processor() -> str:
    """What tells kinds of processors apart."""
    told = {line for line in _cpuinfo() if line.startswith(("model name", "flags", "Features"))}
    return "\n".join([platform.machine(), platform.processor(), *sorted(told)])


def _cpuinfo() -> list[str]:
    """The lines in which Linux describes its processors; none on another system."""
    with contextlib.suppress(OSError):
        return Path("/proc/cpuinfo").read_text().splitlines()
    return []


def import_mujoco() -> None:
    """Import MuJoCo also where ``MUJOCO_GL`` names a renderer that it cannot load.

    MuJoCo reads the variable when it is imported, and fails then. Only `mujoco.Renderer` uses what it names;
    `fmpjax.viz.render` finds its own renderer.
    """
    before = {name: os.environ.get(name) for name in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    try:
        import mujoco  # noqa: F401
    except Exception:
        if not before["MUJOCO_GL"]:
            raise
        # OpenGL has settled on the platform that failed: it has to be imported again for another one.
        for name in list(sys.modules):
            if name.split(".")[0] == "OpenGL" or name.startswith(("mujoco.egl", "mujoco.osmesa", "mujoco.cgl")):
                del sys.modules[name]
        os.environ.pop("MUJOCO_GL")
        _restore("PYOPENGL_PLATFORM", before["PYOPENGL_PLATFORM"])
        try:
            import mujoco  # noqa: F811
        finally:
            _restore("MUJOCO_GL", before["MUJOCO_GL"])
        # The failed import left these behind, and a new package does not name what is imported already.
        for name, module in list(sys.modules.items()):
            if name.count(".") == 1 and name.startswith("mujoco."):
                setattr(mujoco, name.partition(".")[2], module)


def import_mjx() -> None:
    """Import MJX, which prints where Warp, which is optional, is not installed."""
    with contextlib.redirect_stdout(io.StringIO()):
        import mujoco.mjx  # noqa: F401


def _restore(name: str, value: str | None) -> None:
    if value is None:
        os.environ.pop(name, None)
    else:
        os.environ[name] = value

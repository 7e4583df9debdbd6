"""What the tests share.

``FMPJAX_TEST_DATA`` may name a folder with data that is not shipped; tests pass without it. ``FMPJAX_TEST_SHAPES=0``
leaves out the checks of the shapes that functions state.
"""

import gc
import os
import sys
import tempfile
from collections import Counter
from pathlib import Path

# Before JAX is imported: the figures the tests compare are those of the CPU unless the caller says otherwise.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Four fake devices, on which programs that several devices share are tested; everything else runs on the first.
# Compiling is most of the time. It takes a third without optimization and without the emitters of fused loops, and
# less again if a program is not divided among threads, since all cores are busy.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_force_host_platform_device_count=4 --xla_backend_optimization_level=0 "
    "--xla_llvm_disable_expensive_passes=true --xla_cpu_use_fusion_emitters=false "
    "--xla_cpu_parallel_codegen_split_count=1",
)
# Programs, the smallest too, are compiled once for all processes of the tests, and for the next time.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(tempfile.gettempdir()) / f"fmpjax-tests-{os.getuid()}"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
# A device that waits for the others holds one of the threads of XLA, which makes one a core: too few are a deadlock.
os.environ.setdefault("NPROC", str(2 * max(os.cpu_count() or 1, 4)))

import jax
import jaxtyping
import pytest

import tests.shapes  # noqa: F401 - the hook finds it by its name

# Before the package is imported: each call of these modules' functions is checked against its annotations.
CHECKED = [
    f"fmpjax.{name}"
    for name in ("features", "frames", "learning", "potential", "priors.base", "priors.flow", "rotations", "transport")
]
if os.environ.get("FMPJAX_TEST_SHAPES") != "0":
    jaxtyping.install_import_hook(CHECKED, "tests.shapes.checked")

from fmpjax import config, motion, robots  # noqa: E402
from fmpjax.trainer import Trainer  # noqa: E402

# What is imported stays, and tracing makes many small objects: collecting them as often as usual takes a twentieth.
gc.freeze()
gc.set_threshold(50_000, 20, 50)

# Processes that tests start run this checkout's code, and without Warp, whose import takes them seconds.
WITHOUT_WARP = str(Path(__file__).parent / "without_warp")
os.environ["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parents[1]), WITHOUT_WARP])
sys.path[:] = [path for path in sys.path if path != WITHOUT_WARP]  # where this is such a process itself, of xdist


def pytest_collection_modifyitems(items):
    """Files with the most slow tests come first: none is left for one process at the end."""
    slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: -slow[item.path])


@pytest.fixture(scope="module", autouse=True)
def few_programs():
    """Compiled programs are let go before they are too many: each has memory maps, of which Linux allows 65,530."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > 20_000:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="session", autouse=True)
def once_compiled():
    """FMP's program is traced and compiled once for all runs of a configuration, which takes seconds each time."""
    programs, compiled = {}, Trainer.compile
    free = ("transitions", "seed", "evaluations", "evaluation_episodes", "motion", "frames")  # not in the program

    def compile_once(self, state):
        if self.config.method != "fmp":
            return compiled(self, state)
        said = {key: value for key, value in config.flatten(self.config).items() if key not in free}
        clips = [(clip.qpos.tobytes(), clip.qvel.tobytes()) for clip in self.library.clips]
        leaves = [(x.shape, x.dtype, x.sharding) for x in jax.tree.leaves(state)]
        key = hash((repr(said), repr(leaves), tuple(clips), self.library.weights))
        if key not in programs:
            programs[key] = compiled(self, state)
        return programs[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Trainer, "compile", compile_once)
        yield


@pytest.fixture(scope="session")
def robot():
    return robots.load("unitree_g1")


@pytest.fixture(scope="session")
def walk():
    return motion.load("walk")


@pytest.fixture(scope="session")
def data():
    """Folder of the recorded figures."""
    return Path(__file__).parent / "data"


@pytest.fixture(scope="session")
def external():
    """A function from a file's name to its path below ``FMPJAX_TEST_DATA``; it skips the test without one."""

    def find(name: str) -> Path:
        if "FMPJAX_TEST_DATA" not in os.environ:
            pytest.skip("FMPJAX_TEST_DATA names no data folder")
        found = sorted(Path(os.environ["FMPJAX_TEST_DATA"]).rglob(name))
        if not found:
            pytest.skip(f"no {name} there")
        return found[0]

    return find

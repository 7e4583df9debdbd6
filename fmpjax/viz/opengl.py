"""Pictures by MuJoCo through an OpenGL platform without a screen, and which one works here."""

import contextlib
import copy
import functools
import importlib
import os
import subprocess
import sys
from collections.abc import Generator

import mujoco
import numpy as np

from fmpjax.robots import Robot
from fmpjax.viz.picture import Picture

_HERE = ("cgl",) if sys.platform == "darwin" else ("egl", "osmesa")  # what MuJoCo may draw through on this system
_OFF = ("disable", "disabled", "off", "false", "0")
_ANY = ("", "enable", "enabled", "on", "true", "1", "glfw", "glx")  # what MuJoCo knows beside, and what needs a window
AZIMUTH, ELEVATION = 125.0, -10.0  # deg; the robot walks along +x, past the camera and a little toward it
GHOST_RGBA = (0.20, 0.55, 0.95, 0.16)
HIDDEN_GROUPS = slice(3, None)  # geoms that only collide or mark falls
# A context that opens is not enough: without a driver the first use of it fails, and may take the process with it.
_PROBE = """
import importlib, sys
import mujoco
context = importlib.import_module("mujoco." + sys.argv[1]).GLContext(64, 64)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), mujoco.mjtFontScale.mjFONTSCALE_100)
"""


@functools.cache
def backend() -> str:
    """What draws here, one of `BACKENDS`.

    The environment variable ``MUJOCO_GL`` may ask for ``egl``, ``osmesa`` or ``cgl``, which is tried first, or for
    none of them by ``disable``. Where what it asks for does not draw, a sentence on standard error says what does.
    """
    asked = os.environ.get("MUJOCO_GL", "").lower().strip()
    if asked in _OFF:
        return "skeleton"
    found = next((name for name in sorted(_HERE, key=lambda name: name != asked) if _draws(name)), "skeleton")
    if asked not in (*_ANY, found):
        say(f"MUJOCO_GL is {asked!r}, which draws nothing here: pictures are drawn by {found!r} instead")
    return found


def _draws(name: str) -> bool:
    command = [sys.executable, "-c", _PROBE, name]
    # A name that MuJoCo does not know would keep the probe from importing it.
    environment = os.environ | {"MUJOCO_GL": name}
    with contextlib.suppress(subprocess.TimeoutExpired):
        return subprocess.run(command, env=environment, capture_output=True, timeout=60).returncode == 0
    return False


@functools.cache  # once in a process
def say(sentence: str) -> None:
    """Print a sentence on standard error, the first time that it is said."""
    print(f"fmpjax: {sentence}", file=sys.stderr, flush=True)


class DriverError(Exception):
    """MuJoCo cannot draw through a platform, though the probe could."""


@contextlib.contextmanager
def drawing(
    name: str, robot: Robot, width: int, height: int, distance: float, *, smooth: bool = True
) -> Generator[Picture]:
    """Draw with MuJoCo through the OpenGL platform ``name``, with smooth edges or, in half the time, without."""
    model = copy.copy(robot.model)
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    quality = model.vis.quality  # more is not seen at this size; without a GPU drawing takes a third less time
    quality.numslices, quality.numstacks, quality.shadowsize = 14, 10, 1024
    quality.offsamples = quality.offsamples if smooth else 0
    data = mujoco.MjData(model)
    camera, option, perturb = mujoco.MjvCamera(), mujoco.MjvOption(), mujoco.MjvPerturb()
    camera.azimuth, camera.elevation, camera.distance = AZIMUTH, ELEVATION, distance
    option.geomgroup[HIDDEN_GROUPS] = 0
    scene = mujoco.MjvScene(model, maxgeom=3 * model.ngeom + 100)
    rectangle = mujoco.MjrRect(0, 0, width, height)
    # mujoco.Renderer takes its platform from MUJOCO_GL at the first import of mujoco, which is long past.
    try:
        platform = importlib.import_module(f"mujoco.{name}").GLContext(width, height)
        platform.make_current()
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    except Exception as error:  # of any kind: each platform has its own
        raise DriverError(str(error).strip().partition("\n")[0] or type(error).__name__) from error
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)

    def pose(qpos: np.ndarray) -> None:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)

    def picture(configurations: list[np.ndarray], look: np.ndarray) -> np.ndarray:
        camera.lookat[:] = look
        pose(configurations[0])
        mujoco.mjv_updateScene(model, data, option, perturb, camera, mujoco.mjtCatBit.mjCAT_ALL, scene)
        for ghost in configurations[1:]:
            solid = scene.ngeom
            pose(ghost)
            mujoco.mjv_addGeoms(model, data, option, perturb, mujoco.mjtCatBit.mjCAT_DYNAMIC, scene)
            for geom in scene.geoms[solid : scene.ngeom]:
                geom.matid = -1
                geom.rgba[:] = GHOST_RGBA
        image = np.empty((height, width, 3), np.uint8)
        mujoco.mjr_render(rectangle, scene, context)
        mujoco.mjr_readPixels(image, None, rectangle, context)
        return image[::-1]

    try:
        yield picture
    finally:
        context.free()
        platform.free()

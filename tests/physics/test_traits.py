"""Robots and floors that differ from their model, against MuJoCo with a model that was changed by hand."""

import copy
import dataclasses
import shutil

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from fmpjax import physics, robots
from fmpjax.config import disturbance, preset
from fmpjax.errors import UserError
from fmpjax.physics import traits
from fmpjax.physics.traits import Traits
from tests.helpers import nominal_traits, other_traits

LAPTOP = dataclasses.replace(preset("laptop").physics, backend="native")
COUNT = 4


@pytest.fixture(scope="module")
def states(walk):
    rng = np.random.default_rng(1)
    rows = np.linspace(10, len(walk) - 1, COUNT).astype(int)
    qpos, qvel = walk.qpos[rows].copy(), walk.qvel[rows].copy()
    qpos[:, 2] -= 0.002  # pressed a little into the floor
    targets = qpos[:, 7:] + 0.3 * rng.normal(size=qpos[:, 7:].shape)
    return (*(jnp.asarray(x, jnp.float32) for x in (qpos, qvel)), jnp.asarray(targets, jnp.float32))


def by_hand(robot, config, state, targets, own: Traits):
    """One control step by MuJoCo's own loop, under ``targets [S, J]`` of each physics step, of a model changed here."""
    model = copy.copy(physics.make(robot, config, uneven=bool(np.any(own.floors))).model)
    if np.any(own.floors):
        model.geom("left_floor").pos[2], model.geom("right_floor").pos[2] = own.floors
    torso = model.body("torso_link").id
    floor = [i for i in range(model.ngeom) if any(part in model.geom(i).name for part in ("floor", "_foot_"))]
    assert len(floor) > 2
    model.geom_friction[floor, 0] *= float(own.friction[0])
    mass = model.body_mass[torso]
    model.body_mass[torso] += float(own.torso_mass[0])
    model.body_inertia[torso] *= model.body_mass[torso] / mass
    model.body_ipos[torso] += np.asarray(own.torso_center, np.float64)
    model.body_sameframe[torso] = 0
    model.actuator_gainprm[:, 0] *= own.stiffness
    model.actuator_biasprm[:, 1] *= own.stiffness
    model.actuator_biasprm[:, 2] *= own.damping
    model.actuator_forcerange *= np.asarray(own.strength)[:, None]
    model.jnt_actfrcrange[1:] *= np.asarray(own.strength)[:, None]
    model.dof_frictionloss[6:] = own.joint_friction
    model.dof_armature[6:] *= own.armature
    x, y = np.sin(np.asarray(own.slope, np.float64))
    model.opt.gravity[:] = -9.81 * np.array([x, y, 1.0]) / np.sqrt(x**2 + y**2 + 1.0)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = state
    for target in targets:
        data.ctrl[:] = target
        mujoco.mj_step(model, data)
    return data.qpos.copy(), data.qvel.copy()


@pytest.mark.parametrize("name", [*Traits._fields, "all"])
def test_a_trait_is_what_mujoco_makes_of_a_changed_model(robot, states, name):
    qpos, qvel, targets = states
    backend = physics.make(robot, LAPTOP, uneven=name in ("floors", "all"))
    plain = nominal_traits(robot, COUNT)
    own = (
        other_traits(robot, COUNT)
        if name == "all"
        else plain._replace(**{name: getattr(other_traits(robot, COUNT), name)})
    )
    start = physics.reset(qpos, qvel)
    after = jax.jit(backend.step)(start, targets, own)
    before = jax.jit(backend.step)(start, targets)
    assert np.abs(np.asarray(after.qvel) - np.asarray(before.qvel)).max() > 1e-4, "the trait changes nothing"
    for i in range(COUNT):
        row = Traits(*(np.asarray(x)[i] for x in own))
        found = by_hand(robot, LAPTOP, (qpos[i], qvel[i]), [targets[i]] * LAPTOP.substeps, row)
        np.testing.assert_allclose(after.qpos[i], found[0], atol=2e-6)
        np.testing.assert_allclose(after.qvel[i], found[1], rtol=1e-4, atol=1e-4)


def test_the_models_own_traits_change_no_bit(robot, states):
    qpos, qvel, targets = states
    backend, start = physics.make(robot, LAPTOP), physics.reset(qpos, qvel)
    plain = jax.jit(backend.step)(start, targets)
    for held in (targets, jnp.repeat(targets[:, None], LAPTOP.substeps, axis=1)):
        own = jax.jit(backend.step)(start, held, nominal_traits(robot, COUNT))
        for a, b in zip(plain, own, strict=True):
            np.testing.assert_array_equal(a, b)


def test_level_floors_of_the_feet_are_one_floor(robot, states):
    qpos, qvel, targets = states
    start, own = physics.reset(qpos, qvel), nominal_traits(robot, COUNT)
    even, parted = (jax.jit(physics.make(robot, LAPTOP, uneven=uneven).step) for uneven in (False, True))
    for a, b in zip(even(start, targets, own), parted(start, targets, own), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)


def test_floors_change_from_step_to_step(robot, states):
    """Models are kept, and no height of an earlier step stays in them."""
    qpos, qvel, targets = states
    backend, start = physics.make(robot, LAPTOP, uneven=True), physics.reset(qpos, qvel)
    step, own = jax.jit(backend.step), nominal_traits(robot, COUNT)
    # One robot, floors of different heights: each row has a model of its own.
    start, targets = jax.tree.map(lambda x: jnp.broadcast_to(x[:1], x.shape), (start, targets))
    level = step(start, targets, own)
    heights = 0.005 * jnp.arange(COUNT)
    raised = step(start, targets, own._replace(floors=jnp.stack([heights, heights], axis=1)))
    np.testing.assert_array_equal(raised.qvel[0], level.qvel[0])
    gaps = np.abs(np.asarray(raised.qvel[1:] - raised.qvel[:-1])).max(axis=-1)
    assert (gaps > 0.1).all()
    for a, b in zip(level, step(start, targets, own), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_raised_floor_bears_a_robot_above_the_level(robot):
    """MuJoCo's tree of boxes ends at the level of the floor that was compiled, and would let the feet through."""
    backend, own = physics.make(robot, LAPTOP, uneven=True), nominal_traits(robot, 2)
    qpos = np.tile(robot.default_qpos, (2, 1))
    qpos[:, 2] += 0.01
    start = physics.reset(jnp.asarray(qpos, jnp.float32), jnp.zeros((2, robot.joint_count + 6)))
    targets = jnp.asarray(qpos[:, 7:], jnp.float32)
    fell = jax.jit(backend.step)(start, targets, own._replace(floors=jnp.array([[0.0, 0.0], [0.012, 0.012]]))).qvel[
        :, 2
    ]
    assert fell[0] < -0.15 and fell[1] > -0.1


@pytest.mark.parametrize("name", ["unitree_g1", "unitree_g1_29dof", "strider"])
def test_a_foot_on_the_lowest_floor_leaves_the_shank_above_the_level(name):
    robot = robots.load(name)
    model, data = robot.physics_model(), mujoco.MjData(robot.physics_model())
    data.qpos[:] = robot.default_qpos
    mujoco.mj_kinematics(model, data)

    def lowest(geom):
        rotation, size = data.geom_xmat[geom].reshape(3, 3), model.geom_size[geom]
        reach = size[0] + (
            size[1] * abs(rotation[2, 2]) if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE else 0
        )
        return data.geom_xpos[geom][2] - reach

    floor = model.geom("floor")
    touch = (model.geom_contype & floor.conaffinity | model.geom_conaffinity & floor.contype) != 0
    names = [model.geom(i).name for i in range(model.ngeom)]
    soles = min(lowest(i) for i in np.flatnonzero(touch) if "_foot_" in names[i])
    others = [lowest(i) for i in np.flatnonzero(touch) if "_foot_" not in names[i] and names[i] != "floor"]
    assert min(others) - soles > disturbance._HIGHEST / 2


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            ("<worldbody>", '<worldbody><geom name="box" type="box" size="1 1 1"/>'),
            "a world of one plane, the floor: that",
        ),
        (('conaffinity="1" condim', 'conaffinity="1073741823" condim'), "three bits that no contype or conaffinity"),
    ],
)
def test_a_robot_whose_ground_cannot_be_uneven_says_so(tmp_path, change, said):
    folder = tmp_path / "mine"
    shutil.copytree(robots.load("strider").path.parent, folder)
    file = folder / "robot.xml"
    assert change[0] in file.read_text()
    file.write_text(file.read_text().replace(*change))
    robot = robots.load(str(folder))
    physics.make(robot, LAPTOP)
    with pytest.raises(UserError, match=f"disturbance.step_height needs {said}"):
        physics.make(robot, LAPTOP, uneven=True)


@pytest.mark.parametrize("name", ["unitree_g1", "unitree_g1_29dof", "strider"])
def test_each_foot_has_a_floor_of_its_own(name):
    """What collides stays the same but for the feet, each of which leaves the common floor for its own."""

    def colliding(model):
        kinds, takes = model.geom_contype, model.geom_conaffinity
        pairs = np.argwhere(np.triu((kinds[:, None] & takes | kinds & takes[:, None]) != 0, 1))
        return {frozenset(model.geom(i).name for i in pair) for pair in pairs}

    robot = robots.load(name)
    even, parted = colliding(robot.physics_model()), colliding(robot.physics_model(uneven=True))

    def other(pair):
        sole = next((geom for geom in pair if "_foot_" in geom), "")
        return pair - {"floor"} | {sole.partition("_")[0] + "_floor"} if sole and "floor" in pair else pair

    assert {other(pair) for pair in even} == parted and even != parted


def test_targets_of_each_physics_step(robot, states):
    qpos, qvel, targets = states
    backend = physics.make(robot, LAPTOP)
    several = jnp.stack([targets, targets + 0.2], axis=1)
    after = jax.jit(backend.step)(physics.reset(qpos, qvel), several)
    own = Traits(*(np.asarray(x)[0] for x in nominal_traits(robot, COUNT)))
    for i in range(COUNT):
        found = by_hand(robot, LAPTOP, (qpos[i], qvel[i]), several[i], own)
        np.testing.assert_allclose(after.qvel[i], found[1], rtol=1e-4, atol=1e-4)


def test_traits_of_batches_of_batches(robot, states):
    qpos, qvel, targets = states
    backend, own = physics.make(robot, LAPTOP), other_traits(robot, COUNT)
    start = physics.reset(qpos, qvel)
    together = jax.jit(backend.step)(start, targets, own)
    pairs = jax.tree.map(lambda x: x.reshape(2, 2, *x.shape[1:]), (start, targets, own))
    apart = jax.jit(jax.vmap(backend.step))(*pairs)
    for a, b in zip(together, apart, strict=True):
        np.testing.assert_array_equal(a, np.reshape(b, a.shape))


def test_joint_friction_is_refused_by_mjx(robot):
    with pytest.raises(UserError, match="joint_friction needs physics.backend=native or physics.impl=warp"):
        physics.make(robot, dataclasses.replace(LAPTOP, backend="mjx"), joint_friction=True)


def test_a_robot_without_a_torso_is_refused(robot):
    nameless = dataclasses.replace(robot, landmarks={})
    with pytest.raises(UserError, match=r"robot unitree_g1 has no chest among the \[landmarks\] of its robot.toml"):
        traits.torso_body(nameless)
    assert traits.torso_body(robots.load("unitree_g1_29dof")) >= 0


def test_gravity_above_a_slope(robot):
    np.testing.assert_allclose(traits.gravity(jnp.zeros((1, 2))), [[0, 0, -1]])
    down = np.asarray(traits.gravity(jnp.array([[0.1, 0.0]])))[0]
    np.testing.assert_allclose(np.linalg.norm(down), 1.0, rtol=1e-6)
    assert down[0] < 0 and np.arcsin(-down[0]) == pytest.approx(0.1, abs=1e-3)  # uphill is ahead

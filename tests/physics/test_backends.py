"""The backends against MuJoCo's own step loop and against each other, and the servos against what they promise."""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from fmpjax import physics, robots
from fmpjax.config import PhysicsConfig, preset
from fmpjax.errors import UserError
from fmpjax.physics import ffi, native
from tests.helpers import nominal_traits, other_traits

PAPER = PhysicsConfig(backend="native")
LAPTOP = dataclasses.replace(preset("laptop").physics, backend="native")


@pytest.fixture(scope="module")
def states(robot, walk):
    """Twelve states - standing, in the air, walking - and joint targets near them."""
    rng = np.random.default_rng(0)
    rows = np.linspace(10, len(walk) - 1, 8).astype(int)
    standing = np.stack([robot.default_qpos] * 4)
    standing[2:, 2] += 0.5
    walking = walk.qpos[rows].copy()
    # The clip's soles graze the floor, where rounding decides whether there is a contact: press them a little into it.
    walking[:, 2] -= 0.002
    qpos = np.concatenate([standing, walking])
    qvel = np.concatenate([np.zeros((4, walk.qvel.shape[1])), walk.qvel[rows]])
    qvel[2:4] = 0.5 * rng.normal(size=(2, qvel.shape[1]))
    targets = qpos[:, 7:] + 0.1 * rng.normal(size=(12, robot.joint_count))
    return (*(x.astype(np.float32) for x in (qpos, qvel)), targets.astype(np.float32))


def advance(backend, qpos, qvel, targets, steps, *traits):
    """States after each of some control steps with held targets, ``[steps, N, ...]``."""

    def one(state, _):
        state = backend.step(state, jnp.asarray(targets), *traits)
        return state, state

    start = physics.reset(jnp.asarray(qpos), jnp.asarray(qvel))
    _, course = jax.jit(lambda s: jax.lax.scan(one, s, None, length=steps))(start)
    return jax.tree.map(np.asarray, course)


# --- native against MuJoCo -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("config", [PAPER, LAPTOP], ids=["200 Hz", "100 Hz"])
def test_native_equals_the_plain_step_loop(robot, states, config):
    """The same solver agrees to rounding; MuJoCo's own settings, solved until nothing changes, to its tolerance."""
    qpos, qvel, targets = states
    backend = physics.make(robot, config)
    course = advance(backend, qpos, qvel, targets, 3)
    plain = native.model(robot, config)
    assert plain.opt.timestep == config.timestep and plain.opt.iterations == config.iterations
    assert (plain.dof_frictionloss[6:] == config.frictionloss).all()
    plain.opt.iterations, plain.opt.ls_iterations, plain.opt.tolerance = 200, 50, 0.0
    for model, exact in ((backend.model, 1e-6), (plain, 1e-4)):
        data = mujoco.MjData(model)
        for i in range(len(qpos)):
            mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[i], qvel[i], targets[i]
            # The state is handed on as float32 after each control step.
            for step in range(3):
                for _ in range(config.substeps):
                    mujoco.mj_step(model, data)
                np.testing.assert_allclose(course.qpos[step, i], data.qpos, atol=1e-6)
                np.testing.assert_allclose(course.qvel[step, i], data.qvel, rtol=1e-6, atol=exact)
                data.qpos[:], data.qvel[:] = course.qpos[step, i], course.qvel[step, i]


def test_native_does_not_depend_on_threads_or_order(robot, states):
    qpos, qvel, targets = (np.concatenate([x, x[::-1], x]) for x in states)
    one = advance(physics.make(robot, dataclasses.replace(LAPTOP, threads=1)), qpos, qvel, targets, 10)
    three = physics.make(robot, dataclasses.replace(LAPTOP, threads=3))
    order = np.random.default_rng(0).permutation(len(qpos))
    for indices in (np.arange(len(qpos)), order, order[:5]):
        many = advance(three, qpos[indices], qvel[indices], targets[indices], 10)
        for a, b in zip(one, many, strict=True):
            np.testing.assert_array_equal(a[:, indices], b)


def test_a_state_that_is_not_finite_shows_and_stays_alone(robot, states):
    qpos, qvel, targets = states
    backend = physics.make(robot, LAPTOP)
    good = advance(backend, qpos, qvel, targets, 2)
    bad = qvel.copy()
    bad[1, 8], bad[5, 0] = np.nan, 1e30
    with np.errstate(all="ignore"):
        struck = advance(backend, qpos, bad, targets, 2)
    others = np.array([i not in (1, 5) for i in range(len(qpos))])
    for a, b in zip(good, struck, strict=True):
        np.testing.assert_array_equal(a[:, others], b[:, others])
    for i in (1, 5):
        velocity = struck.qvel[0, i]
        assert not np.isfinite(velocity).all() or np.abs(velocity).max() > 1e3


# --- servos ----------------------------------------------------------------------------------------------------------


def test_servos_hold_their_force_limits(robot):
    model = native.model(robot, PAPER)
    data = mujoco.MjData(model)
    for sign in (-1.0, 1.0):
        data.qpos[:] = robot.default_qpos
        data.qpos[2], data.qvel[:] = 10.0, 0.0
        data.ctrl[:] = sign * 1e3
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(data.actuator_force, sign * robot.effort, rtol=1e-9)
        np.testing.assert_allclose(data.qfrc_actuator[6:], sign * robot.effort, rtol=1e-9)
    assert robot.effort.min() > 0 and robot.effort.max() < 200


def test_servos_are_springs_with_damping(robot):
    """Force = kp (target - angle) - kd velocity, kp = armature (2 pi 10)^2 and kd = 4 armature 2 pi 10."""
    model = native.model(robot, PAPER)
    data = mujoco.MjData(model)
    data.qpos[:] = robot.default_qpos
    rng = np.random.default_rng(0)
    data.qvel[6:] = 0.05 * rng.normal(size=robot.joint_count)
    data.ctrl[:] = robot.default_qpos[7:] + 0.02 * rng.normal(size=robot.joint_count)
    mujoco.mj_forward(model, data)
    kp, kd = model.dof_armature[6:] * (2 * np.pi * 10) ** 2, 4 * model.dof_armature[6:] * 2 * np.pi * 10
    expected = kp * (data.ctrl - data.qpos[7:]) - kd * data.qvel[6:]
    np.testing.assert_allclose(data.actuator_force, expected, rtol=1e-5)


def test_servos_reach_their_targets(robot):
    """In free fall, where nothing pulls at the joints, every joint comes to its target within a second."""
    rng = np.random.default_rng(0)
    qpos = robot.default_qpos[None].repeat(4, 0)
    qpos[:, 2] = 20.0
    targets = np.clip(qpos[:, 7:] + 0.2 * rng.uniform(-1, 1, (4, robot.joint_count)), robot.joint_low, robot.joint_high)
    course = advance(
        physics.make(robot, PAPER),
        qpos.astype(np.float32),
        np.zeros((4, 35), np.float32),
        targets.astype(np.float32),
        50,
    )
    error = np.abs(course.qpos[-1, :, 7:] - targets)
    print(f"servos after 1 s: worst error {error.max():.4f} rad")
    assert error.max() < 0.02
    # Half way the hinges are on their way, not there at once: a servo has a force limit.
    assert np.abs(course.qpos[0, :, 7:] - targets).max() > 0.05


# --- rates -----------------------------------------------------------------------------------------------------------


def test_laptop_rate_holds_the_standing_robot_like_the_paper_rate(robot):
    """Ten control steps of standing at 100 Hz end where 200 Hz ends them: root within 2 mm, joints within 0.02 rad."""
    qpos = robot.default_qpos[None].astype(np.float32)
    courses = [
        advance(physics.make(robot, c), qpos, np.zeros((1, 35), np.float32), qpos[:, 7:], 10) for c in (PAPER, LAPTOP)
    ]
    gap = np.abs(courses[0].qpos - courses[1].qpos)
    print(f"100 Hz against 200 Hz: root {gap[..., :3].max() * 1e3:.2f} mm, joints {gap[..., 7:].max():.4f} rad")
    assert gap[..., :3].max() < 2e-3 and gap[..., 7:].max() < 0.02
    for course in courses:
        # The legs carry it: without servos the pelvis would be 20 cm lower by now.
        assert np.abs(course.qpos[..., 2] - qpos[0, 2]).max() < 0.01


def test_laptop_rate_walks_like_the_paper_rate(robot, states):
    """From walking states with held targets, three control steps differ by less than 1 cm and 0.05 rad."""
    qpos, qvel, _ = (x[4:] for x in states)
    courses = [advance(physics.make(robot, c), qpos, qvel, qpos[:, 7:], 3) for c in (PAPER, LAPTOP)]
    gap = np.abs(courses[0].qpos - courses[1].qpos)
    print(
        f"100 Hz against 200 Hz, walking: root {gap[..., :3].max() * 1e3:.2f} mm, joints {gap[..., 7:].max():.4f} rad"
    )
    assert gap[..., :3].max() < 0.01 and gap[..., 7:].max() < 0.05


# --- MJX -------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_mjx_steps_like_native(robot, states):
    """Both backends from the same standing, flying and walking states, three control steps with the same targets.

    Robots with traits of their own walk beside those of the model: one program, since compiling it is most of the time.
    """
    pick = np.array([0, 1, 2, 3, 4, 6, 9, 11, 4, 6, 9])
    qpos, qvel, targets = (x[pick] for x in states)
    targets[8:] += 0.3 * np.sign(targets[8:] - qpos[8:, 7:])  # so far that servos reach their force limits
    stiffness, effort = physics.native.model(robot, LAPTOP).actuator_gainprm[:, 0], robot.effort
    assert (np.abs(stiffness * (targets[8:] - qpos[8:, 7:])) > effort).any()
    plain, own = (
        nominal_traits(robot, 8),
        other_traits(robot, 3)._replace(joint_friction=nominal_traits(robot, 3).joint_friction),
    )
    traits = jax.tree.map(lambda *x: jnp.concatenate(x), plain, own)
    several = np.stack([targets, targets + 0.1], axis=1)  # of each physics step, as delays make them
    config = dataclasses.replace(LAPTOP, iterations=10, ls_iterations=20)
    mjx = dataclasses.replace(config, backend="mjx", impl="jax")
    ours, theirs = (advance(physics.make(robot, c, uneven=True), qpos, qvel, several, 3, traits) for c in (config, mjx))
    gaps = {}
    kinds = {"standing": slice(0, 2), "in the air": slice(2, 4), "walking": slice(4, 8), "other robots": slice(8, None)}
    for name, rows in kinds.items():
        gap = gaps[name] = [np.abs(a - b)[:, rows].max(axis=(1, 2)) for a, b in zip(ours[:2], theirs[:2], strict=True)]
        shown = ["[" + " ".join(f"{v:.1e}" for v in g) + "]" for g in gap]
        print(f"native and MJX, {name}: qpos {shown[0]} m or rad, qvel {shown[1]} m/s or rad/s after each step")
    for name, (position, velocity) in gaps.items():
        assert position.max() < 1e-5 and velocity.max() < 1e-3, name


@pytest.mark.slow
def test_mjx_advances_seeds_at_once_and_each_on_its_own():
    """An axis of seeds over the batch changes no world, and targets that have none serve every seed: as MuJoCo C does.

    The robot is another one than the others' here, with other joints in another order.
    """
    small = robots.load("strider")
    rng = np.random.default_rng(0)
    qpos = np.stack([small.default_qpos] * 4).astype(np.float32)
    qvel = 0.3 * rng.normal(size=(4, qpos.shape[1] - 1)).astype(np.float32)
    targets = jnp.asarray(qpos[:2, 7:] + 0.1 * rng.normal(size=qpos[:2, 7:].shape).astype(np.float32))
    config = dataclasses.replace(LAPTOP, iterations=10, ls_iterations=20)
    backend, native = (physics.make(small, dataclasses.replace(config, backend=name)) for name in ("mjx", "native"))
    together = jax.jit(jax.vmap(lambda q, v: backend.step(physics.reset(q, v), targets)))(
        qpos.reshape(2, 2, -1), qvel.reshape(2, 2, -1)
    )
    apart = jax.jit(native.step)(physics.reset(jnp.asarray(qpos), jnp.asarray(qvel)), jnp.tile(targets, (2, 1)))
    for a, b, tolerance in zip(together[:2], apart[:2], (1e-5, 1e-3), strict=True):
        np.testing.assert_allclose(a.reshape(b.shape), b, atol=tolerance)
        assert np.abs(b[0] - b[2]).max() > 1e-3


def test_auto_is_native_on_a_cpu(robot):
    expected = "native" if jax.default_backend() == "cpu" else "mjx"
    assert physics.make(robot, PhysicsConfig()).name == expected


# --- Warp, which runs on a CPU too, there in order ------------------------------------------------------------------


@pytest.fixture(scope="module")
def warp():
    pytest.importorskip("warp", reason="fmpjax[warp] is not installed")
    return dataclasses.replace(PAPER, backend="mjx", impl="warp")


@pytest.mark.slow
def test_warp_steps_like_native(robot, states, warp):
    """The same states and targets as MJX in JAX gets, three control steps: robots of the model, and all others."""
    qpos, qvel, targets = states
    several = np.stack([targets, targets, targets + 0.1, targets + 0.1], axis=1)  # of each physics step
    traits = other_traits(robot, len(qpos))
    cases = {"the model": ({}, (targets,)), "others": ({"joint_friction": True, "uneven": True}, (several, traits))}
    for said, (options, arguments) in cases.items():
        ours, theirs = (
            advance(physics.make(robot, config, **options), qpos, qvel, arguments[0], 3, *arguments[1:])
            for config in (PAPER, warp)
        )
        position, velocity = (np.abs(a - b).max(axis=(1, 2)) for a, b in zip(ours[:2], theirs[:2], strict=True))
        print(f"native and Warp, {said}: qpos {position} m or rad, qvel {velocity} m/s or rad/s after each step")
        assert position.max() < 1e-4 and velocity.max() < 1e-2, said


@pytest.mark.slow
def test_seeds_in_warp_have_room_for_the_contacts_of_all(robot, states, warp):
    """Four seeds of one robot that stands, in a buffer that has just room for one robot's contacts."""
    qpos, qvel, targets = (x[:1] for x in states)
    backend = physics.make(robot, dataclasses.replace(warp, max_contacts=10))
    step = jax.jit(jax.vmap(lambda q, v: backend.step(physics.reset(q, v), jnp.asarray(targets))))
    reached = step(np.stack([qpos] * 4), np.stack([qvel] * 4))
    alone = backend.step(physics.reset(*map(jnp.asarray, (qpos, qvel))), jnp.asarray(targets))
    assert np.isfinite(alone.qpos).all()
    for seed in range(4):
        np.testing.assert_allclose(reached.qpos[seed], alone.qpos, atol=1e-6)


@pytest.mark.slow
def test_full_buffers_of_warp_show(robot, states, warp, capfd):
    """Constraints are a world's own; contacts have one buffer, which nobody can say whose loss spoilt."""
    qpos, qvel, targets = (x[:4] for x in states)  # two stand, two are in the air
    few = physics.make(robot, dataclasses.replace(warp, max_constraints=40))
    finite = np.isfinite(advance(few, qpos, qvel, targets, 1).qpos[0]).all(-1)
    np.testing.assert_array_equal(finite, [False, False, True, True])
    none = physics.make(robot, dataclasses.replace(warp, max_contacts=1))
    assert not np.isfinite(advance(none, qpos, qvel, targets, 1).qpos).any()
    assert "overflow" not in capfd.readouterr().out


def test_warp_that_is_not_installed_is_refused(robot, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco.mjx.third_party.mujoco_warp._src.types", None)
    with pytest.raises(UserError, match=r"'warp': it is not installed .*: install fmpjax\[warp\]"):
        physics.make(robot, dataclasses.replace(PAPER, backend="mjx", impl="warp"))


# --- a robot that touches itself -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def entangled():
    """Six states of the paper's robot, hands at its hips, in the air and on the floor, and targets near them."""
    robot = robots.load("unitree_g1_29dof")
    rng = np.random.default_rng(1)
    qpos = np.stack([robot.default_qpos] * 6)
    qpos[:3, 2], qpos[3:, 2] = 3.0, 0.79
    qpos[:, 7:] += 0.05 * rng.normal(size=(6, robot.joint_count))
    targets = qpos[:, 7:] + 0.1 * rng.normal(size=(6, robot.joint_count))
    qvel = 0.2 * rng.normal(size=(6, qpos.shape[1] - 1))
    return robot, (qpos.astype(np.float32), qvel.astype(np.float32), targets.astype(np.float32))


def test_hands_are_pushed_out_of_the_hips(entangled):
    robot, (qpos, qvel, _) = entangled
    shoulder = 7 + robot.joint_names.index("left_shoulder_roll_joint")
    course = advance(physics.make(robot, PAPER), qpos[:3], 0 * qvel[:3], qpos[:3, 7:], 5)
    assert (course.qpos[-1, :, shoulder] > qpos[:3, shoulder] + 0.05).all()


@pytest.mark.slow
@pytest.mark.parametrize("impl", ["jax", "warp"])
def test_mjx_collides_as_native_does(entangled, impl):
    if impl == "warp":
        pytest.importorskip("warp", reason="fmpjax[warp] is not installed")
    robot, states = entangled
    ours = advance(physics.make(robot, PAPER), *states, 2)
    theirs = advance(physics.make(robot, dataclasses.replace(PAPER, backend="mjx", impl=impl)), *states, 2)
    position, velocity = (np.abs(a - b).max(axis=(1, 2)) for a, b in zip(ours[:2], theirs[:2], strict=True))
    print(f"native and {impl}, touching itself: qpos {position}, qvel {velocity}")
    assert position.max() < 2e-4 and velocity.max() < 2e-2


# --- NumPy functions in compiled programs ----------------------------------------------------------------------------


def test_a_foreign_functions_error_ends_the_program():
    """An exception must not be printed and forgotten, with whatever was in memory as the result."""

    def broken(argument, result):
        raise ValueError("no such thing")

    ffi.register("fmpjax_test_broken", broken)
    with pytest.raises(jax.errors.JaxRuntimeError, match="ValueError: no such thing"):
        jax.block_until_ready(jax.jit(lambda x: ffi.call("fmpjax_test_broken", x, 2))(jnp.ones((3, 4))))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_foreign_function_sees_and_fills_the_programs_arrays(dtype):
    ffi.register("fmpjax_test_double", lambda x, y: np.multiply(x[..., :2], 2, out=y))
    with jax.enable_x64(dtype == np.float64):
        given = np.random.default_rng(0).normal(size=(2, 3, 4)).astype(dtype)
        reached = jax.jit(jax.vmap(lambda x: ffi.call("fmpjax_test_double", x, 2)))(given)
        assert reached.dtype == dtype
        np.testing.assert_array_equal(reached, 2 * given[..., :2])


def test_physics_is_called_by_what_it_computes(robot):
    """The name in a program that is kept stands for the model and its options."""
    made = [physics.make(robot, c) for c in (LAPTOP, LAPTOP, PAPER, dataclasses.replace(LAPTOP, substeps=1))]
    assert made[0]._function == made[1]._function and len({each._function for each in made}) == 3
    assert made[0]._first is made[1]._first and made[0]._first is not made[2]._first

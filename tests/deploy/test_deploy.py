"""The ONNX file against the policy that it was made of, and its run on other models against training's own physics."""

import dataclasses
import importlib.util
import json
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from fmpjax import cli, config, deploy, disturbances, features, physics, policy, resources, robots, runs
from fmpjax.acting import Seen
from fmpjax.commands import velocity
from fmpjax.config import preset
from fmpjax.env import action_map
from fmpjax.errors import UserError
from fmpjax.motion import MotionLibrary
from fmpjax.physics.native import NativePhysics
from fmpjax.ppo import PPO
from fmpjax.runs import outputs
from tests.helpers import small_policy as small


def importable(*names):
    return all(importlib.util.find_spec(name) for name in names)


needs_onnx = pytest.mark.skipif(not importable("onnx", "onnxruntime"), reason="the extra deploy is not installed")


def session(path):
    import onnxruntime

    return onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])


# --- the file --------------------------------------------------------------------------------------------------------


def targets(path, observations):
    """Joint targets and actions by ONNX Runtime and the metadata."""
    run = session(path)
    said = run.get_modelmeta().custom_metadata_map
    offset, scale = (np.array(said[key].split(","), np.float32) for key in ("action_offset", "action_scale"))
    actions = np.concatenate([run.run(["actions"], {"obs": x[None]})[0] for x in observations])
    return offset + scale * actions, actions


@needs_onnx
@pytest.mark.parametrize("activation", ["elu", "relu", "swish", "tanh"])
@pytest.mark.parametrize(("observation", "action"), [("compact", "residual"), ("full", "absolute")])
def test_onnxruntime_says_what_numpy_says(tmp_path, robot, walk, observation, action, activation):
    changes = {"env.observation": observation, "env.action": action, "ppo.activation": activation}
    made = small(robot, walk, **changes)
    path, card = deploy.write(tmp_path, made.policy, robot, made.origin)
    run = session(path)
    (taken,), given = run.get_inputs(), run.get_outputs()
    assert (taken.name, taken.shape, taken.type) == ("obs", [1, made.size], "tensor(float)")
    assert (given[0].name, given[0].shape) == ("actions", [1, robot.joint_count])
    observations = np.random.default_rng(1).normal(0, 3, (20, made.size)).astype(np.float32)
    by_onnx, _ = targets(path, observations)
    np.testing.assert_allclose(by_onnx, made.policy(observations), atol=1e-5)
    assert by_onnx.std(0).max() > 1e-3
    assert f"`obs` has {made.size} numbers" in card.read_text()


ESTIMATED = {"env.observation": "deployable", "env.axes": "heading", "ppo.estimator": (8,)}


@needs_onnx
@pytest.mark.parametrize("history", [1, 3])
def test_an_estimator_is_inside_the_file(tmp_path, robot, walk, history):
    made = small(robot, walk, **ESTIMATED, **{"env.observation_history": history})
    assert made.size == history * 93 and made.policy.kernels[0].shape[0] == 97
    observations = np.random.default_rng(1).normal(0, 3, (20, made.size)).astype(np.float32)
    by_onnx, _ = targets(deploy.write(tmp_path, made.policy, robot, made.origin)[0], observations)
    np.testing.assert_allclose(by_onnx, made.policy(observations), atol=1e-5)
    deaf = made.policy._replace(estimator_biases=tuple(0 * bias for bias in made.policy.estimator_biases))
    assert np.abs(deaf(observations) - by_onnx).max() > 1e-3
    policy.save(tmp_path / "policy.npz", made.policy)
    loaded = policy.load(tmp_path / "policy.npz")
    np.testing.assert_array_equal(loaded(observations), made.policy(observations))


@needs_onnx
@pytest.mark.parametrize("estimated", [False, True])
def test_onnxruntime_says_what_the_networks_say(tmp_path, robot, walk, estimated):
    made = small(robot, walk, **{"ppo.hidden": (16, 12), "ppo.mean_init": 0.3} | (ESTIMATED if estimated else {}))
    size = Seen(made.size, 20) if estimated else made.size
    ppo = PPO(size, robot.joint_count, made.config.ppo, estimated=range(4), inputs=range(5, 30))
    seen = np.random.default_rng(0).normal(0.3, 2.0, (64, made.size)).astype(np.float32)
    seen = Seen(jnp.asarray(seen), jnp.asarray(seen[:, :20])) if estimated else jnp.asarray(seen)

    @jax.jit  # each operation alone takes longer to compile
    def network(observations):
        state = ppo.init(jax.random.PRNGKey(0))
        state = state._replace(normalizer=ppo.observe(state.normalizer, seen))
        return state, ppo.act(state, deterministic=True)(observations, jax.random.PRNGKey(0))[0]

    observations = np.random.default_rng(1).normal(0, 3, (20, made.size)).astype(np.float32)
    state, wanted = network(observations)
    actions = action_map(robot, walk, made.config.env.action)
    env = SimpleNamespace(actions=actions, form="deployable" if estimated else "compact")
    trainer = SimpleNamespace(config=made.config, robot=robot, ppo=ppo, env=env)
    taken = policy.of(trainer, state)
    by_onnx, given = targets(deploy.write(tmp_path, taken, robot, made.origin)[0], observations)
    np.testing.assert_allclose(
        by_onnx, np.clip(actions.center + actions.scale * wanted, actions.low, actions.high), atol=1e-5
    )
    within = (by_onnx > taken.low + 1e-4) & (by_onnx < taken.high - 1e-4)
    assert within.mean() > 0.5 and by_onnx.std(0).max() > 1e-3
    np.testing.assert_allclose(given[within], np.asarray(wanted)[within], atol=1e-5)


@needs_onnx
def test_a_target_beyond_the_limits_is_kept_within_them(tmp_path, robot, walk):
    made = small(robot, walk, **{"env.action": "residual"})
    far = made.policy._replace(biases=(*made.policy.biases[:-1], np.full(robot.joint_count, 1e3, np.float32)))
    path, _ = deploy.write(tmp_path, far, robot, made.origin)
    actions = session(path).run(None, {"obs": np.zeros((1, made.size), np.float32)})[0][0]
    np.testing.assert_allclose(far.center + far.scale * actions, far.high, atol=1e-5)


def test_the_metadata_keeps_every_digit_and_hides_where_files_lay(robot, walk):
    made = small(robot, walk)
    said = deploy.metadata(made.policy, robot, made.origin)
    for key, numbers in (
        ("joint_stiffness", robot.stiffness),
        ("joint_damping", robot.damping),
        ("default_joint_pos", made.policy.center),
        ("action_scale", made.policy.scale),
        ("default_qpos", robot.default_qpos),
    ):
        np.testing.assert_array_equal(np.array(said[key].split(","), numbers.dtype), numbers, err_msg=key)
    pairs = np.array([pair.split(";") for pair in said["action_clip"].split(",")], np.float32)
    np.testing.assert_array_equal(pairs, np.stack([made.policy.low, made.policy.high], -1))
    terms = said["observation_names"].split(",")
    assert said["observation_terms_clip"] == ",".join(["-inf;inf"] * len(terms))
    for key, plain in (("scale", 1.0), ("history_length", 0.0), ("flatten_history_dim", 1.0)):
        assert [float(value) for value in said[f"observation_terms_{key}"].split(",")] == [plain] * len(terms), key
    assert len(said["observation_widths"].split(",")) == len(terms)
    assert (said["robot"], said["method"], said["commit"]) == (robot.name, made.config.method, "abc123")
    assert float(said["step_dt"]) == 0.02 and said["command_names"] == ""
    text = json.dumps(said) + deploy.card(made.policy, robot, made.origin)
    assert "secret.csv" in text and "/mine" not in text


def test_the_card_says_licenses_evaluation_and_what_is_not_measured(robot, walk):
    made = small(robot, walk)
    card = deploy.card(made.policy, robot, made.origin)
    assert "| walk | 1 | MIT, bundled with fmpjax |" in card
    assert "| secret.csv | 0.5 | unknown: ask the motion's source |" in card
    assert "The run has no evaluation of this policy" in card
    of_a_folder = deploy.card(made.policy, robot, made.origin._replace(motions=(("gaits/+0.00_+0.40", 1.0),)))
    assert "| +0.00_+0.40 | 1 | MIT, bundled with fmpjax |" in of_a_folder
    assert deploy.unmeasured(robot, "compact") in card.replace("The policy observes", "the policy observes")
    assert all(f"| `{joint}` |" in card for joint in robot.joint_names)
    figures = {"falls": 3, "episodes": 64, "late_speed": None, "demonstration_speed": 0.8578}
    card = deploy.card(made.policy, robot, made.origin._replace(evaluation=figures))
    assert "3 falls in 64 first episodes, late speed undefined, of the demonstration 0.858 m/s" in card
    assert "No disturbance was tried on this policy." in card
    figures["starts"] = [{"noise": 0.0, "falls": 0, "episodes": 1}, {"noise": 0.01, "falls": 7, "episodes": 21}]
    card = deploy.card(made.policy, robot, made.origin._replace(evaluation=figures, changed=True))
    assert "| 0 | 0 | 1 |\n| 0.01 | 7 | 21 |\n" in card and "commit abc123 with changes" in card


def test_the_card_has_the_tables_of_obedience_and_of_disturbances(robot, walk):
    made = small(robot, walk)
    assert "## Steering" not in deploy.card(made.policy, robot, made.origin)
    steering = {"speed_error": 0.12345, "turn_error": None, "falls": 2, "changing_falls": 1, "cells": []}
    tried = {"cells": [{"disturbance": "push", "size": "1 m/s", "falls": 3, "episodes": 64}]}
    card = deploy.card(made.policy, robot, made.origin._replace(steering=steering, robustness=tried))
    assert "| mean error of the speed, m/s | 0.123 | undefined |\n" in card
    assert "| mean error of the turning, rad/s | undefined | undefined |\n" in card
    assert "| falls | 2 | 1 |" in card
    assert "| push | 1 m/s | 3 | 64 |" in card and "No disturbance was tried" not in card
    figures = {"falls": 0, "episodes": 4, "starts": [{"noise": 0.0, "falls": 0, "episodes": 1}]}
    card = deploy.card(made.policy, robot, made.origin._replace(evaluation=figures, robustness=tried))
    assert "| 0 | 0 | 1 |" in card and "were not tried" not in card


def test_the_card_says_how_fast_a_command_may_change(robot, walk):
    told = {"env.observation": "compact", "env.axes": "heading", "command.kind": "velocity"}
    for ramp, said in (((2.0, 1.0), "; it may change by 2 m/s and 1 rad/s in a second at most"), ((), "")):
        made = small(robot, walk, **told, **{"command.ramp": ramp})
        card = deploy.card(made.policy, robot, made.origin)
        line = next(line for line in card.splitlines() if "`velocity_commands`" in line)
        assert said in line and (bool(said) == ("it may change" in line))


@pytest.mark.parametrize(
    ("name", "text"),
    [("steering.json", "[]"), ("robustness.json", "[1]"), ("evaluation.json", "{")],
)
def test_figures_that_cannot_be_read_are_refused(tmp_path, name, text):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.json").write_text(config.to_json(preset("smoke")))
    (tmp_path / "run" / "provenance.json").write_text("{}")
    run = runs.Run.open(tmp_path / "run")
    (run.folder / name).write_text(text)
    with pytest.raises(UserError, match=rf"run/{name} is not a file of `fmpjax evaluate`: expected a JSON"):
        outputs.origin_of(run)


@pytest.mark.parametrize("name", ["unitree_g1", "unitree_g1_29dof", "strider"])
def test_the_parts_of_the_observation_are_what_is_observed(name):
    robot = robots.load(name)
    for observation in ("compact", "full"):
        shape = jax.eval_shape(
            lambda qpos, kind=observation: features.observe(robot, qpos, qpos[..., 1:], kind).actor,  # noqa: B023
            jax.ShapeDtypeStruct((7 + robot.joint_count,), jnp.float32),
        ).shape
        assert shape == (sum(features.observation_terms(robot, observation).values()),)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda p: {"observation": "full"}, r"input of layer 0 has \d+ numbers: expected 237, for 29 joints"),
        (lambda p: {"mean": p.mean[1:]}, r"normalizer has \d+ numbers: expected \d+"),
        (lambda p: {"scale": p.scale[1:]}, "scale has 28 numbers: expected 29"),
        (lambda p: {"kernels": (*p.kernels[:-1], p.kernels[-1][:, 1:])}, "output of the last layer has 28 numbers"),
        (lambda p: {"biases": (*p.biases[:-1], p.biases[-1] * np.nan)}, "the policy's biases are not finite"),
    ],
)
def test_widths_that_do_not_fit_are_refused(robot, walk, change, sentence):
    made = small(robot, walk).policy
    made = made._replace(**change(made))
    with pytest.raises(UserError, match=sentence):
        deploy.check_widths(made, features.observation_terms(robot, made.observation))


def test_an_estimator_of_another_width_is_refused(robot, walk):
    made = small(robot, walk, **ESTIMATED).policy
    made = made._replace(estimator_kernels=(made.estimator_kernels[0], made.estimator_kernels[1][:, 1:]))
    with pytest.raises(UserError, match="input of layer 0 has 97 numbers: expected 96"):
        deploy.check_widths(made, features.observation_terms(robot, made.observation))


@pytest.fixture
def sensed(monkeypatch, robot, walk, tmp_path):
    """A policy that observes what Unitree's program knows, in the order of its own G1 policy; its folder as written."""
    terms = {"base_ang_vel": 3, "projected_gravity": 3, "velocity_commands": 3}
    terms |= {"joint_pos_rel": 29, "joint_vel_rel": 29, "last_action": 29}
    monkeypatch.setattr(features, "observation_terms", lambda robot, observation: terms)
    made = small(robot, walk, **{"env.action": "residual"})
    made.policy = made.policy._replace(kernels=tuple(0.1 * kernel for kernel in made.policy.kernels))
    ranges = {"lin_vel_x": (-0.5, 1.0), "lin_vel_y": (-0.3, 0.3), "ang_vel_z": (-0.8, 0.8)}
    made.origin = made.origin._replace(commands=ranges)
    made.terms, made.folder = terms, tmp_path
    made.paths = deploy.write(tmp_path, made.policy, robot, made.origin) if importable("onnx") else []
    return made


def test_what_unitrees_program_knows_is_written_in_its_form(sensed, robot):
    yaml = pytest.importorskip("yaml")
    said = yaml.safe_load(deploy.stock(sensed.policy, robot, sensed.origin))
    assert said["joint_ids_map"] == list(range(29)) and said["step_dt"] == 0.02
    assert {name: len(part["scale"]) for name, part in said["observations"].items()} == sensed.terms
    assert sum(sensed.terms.values()) == 96 and list(said["observations"]) == list(sensed.terms)
    action = said["actions"]["JointPositionAction"]
    for key, values, numbers in (
        ("scale", action["scale"], sensed.policy.scale),
        ("offset", action["offset"], sensed.policy.center),
        ("clip", action["clip"], np.stack([sensed.policy.low, sensed.policy.high], -1)),
        ("stiffness", said["stiffness"], robot.stiffness),
        ("damping", said["damping"], robot.damping),
        ("default_joint_pos", said["default_joint_pos"], sensed.policy.center),
    ):
        np.testing.assert_array_equal(np.array(values, numbers.dtype), numbers, err_msg=key)
    ranges = said["commands"]["base_velocity"]["ranges"]
    assert ranges == {"lin_vel_x": [-0.5, 1.0], "lin_vel_y": [-0.3, 0.3], "ang_vel_z": [-0.8, 0.8], "heading": None}
    assert deploy.unmeasured(robot, "stock") is None and deploy.no_stock(robot, "stock") is None
    with pytest.raises(UserError, match="takes unknown commands"):
        deploy.stock(sensed.policy, robot, sensed.origin._replace(commands=None))


@needs_onnx
def test_unitrees_program_finds_its_files(sensed):
    written = {str(path.relative_to(sensed.folder)) for path in sensed.paths}
    assert written == {"policy.onnx", "MODEL_CARD.md", "exported/policy.onnx", "params/deploy.yaml"}
    assert (sensed.folder / "exported" / "policy.onnx").read_bytes() == (sensed.folder / "policy.onnx").read_bytes()


def test_joints_in_another_order_are_mapped_to_the_motors(sensed, robot):
    other = dataclasses.replace(robot, joint_names=robot.joint_names[::-1])
    turned = sensed.policy._replace(joint_names=robot.joint_names[::-1])
    assert f"joint_ids_map: {list(range(28, -1, -1))}\n" in deploy.stock(turned, other, sensed.origin)


def test_what_unitrees_program_does_not_know_is_named(robot):
    sentence = deploy.no_stock(robot, "compact")
    assert sentence.startswith("no params/deploy.yaml: Unitree's program does not know the observation root_height, ")
    assert "strider has not the 29 joints" in deploy.no_stock(robots.load("strider"), "compact")


def test_a_missing_package_is_named_with_its_extra(monkeypatch, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.json").write_text(config.to_json(preset("smoke")))
    run = runs.Run.open(tmp_path / "run")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"needs the package onnx, .*: install the extra fmpjax\[deploy\]"):
        runs.export(run, tmp_path / "out", onnx=True)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: True)
    with pytest.raises(UserError, match="run has no checkpoint: --onnx needs one"):
        runs.export(run, tmp_path / "out", onnx=True)
    assert not (tmp_path / "out").exists()


# --- the run on another model ----------------------------------------------------------------------------------------


def mjcf(robot, path, edit=lambda root: None, **options):
    """The robot's file with other solver options, edited."""
    tree = ElementTree.parse(resources.folder("robots") / robot.name / "robot.xml")
    tree.getroot().find("option").attrib.update({key: str(value) for key, value in options.items()})
    edit(tree.getroot())
    tree.write(path)
    return path


def without_servos(root):
    root.remove(root.find("actuator"))


def in_another_order(root):
    pelvis = root.find("worldbody").find("body")
    first = pelvis.find("body")
    pelvis.remove(first)
    pelvis.append(first)


def with_weak_motors(root):
    for servo in root.find("actuator"):
        servo.attrib.update(kp="1", forcerange="-1 1", ctrlrange="-0.1 0.1")


def without_a_mesh(root):
    """A shape for the eye whose file is not there."""
    root.find("asset").append(ElementTree.Element("mesh", name="lost", file="lost.stl"))
    attributes = {"type": "mesh", "mesh": "lost", "contype": "0", "conaffinity": "0"}
    root.find("worldbody").find("body").append(ElementTree.Element("geom", attributes))


def without_a_floor(root):
    world = root.find("worldbody")
    for geom in world.findall("geom"):
        world.remove(geom)


TOLD = np.array([0.3, 0.0, 0.2])  # m/s ahead and to the left, rad/s


TRAINED = (
    "compact",
    "full",
    "compact heading velocity",
    "compact heading velocity ramp",
    "deployable velocity history-3",
)


@pytest.fixture(scope="module", params=TRAINED)
def trained(request, robot, walk, tmp_path_factory):
    """Six steps of training's own physics under a small policy, and the file of that policy."""
    pytest.importorskip("onnxruntime")
    content, *told = request.param.split()
    changes = {"env.observation": content, "physics.timestep": 0.005, "physics.substeps": 4, "physics.threads": 1}
    changes |= {"env.axes": "heading", "command.kind": "velocity"} if told else {}
    changes |= {"command.ramp": (2.0, 1.0)} if "ramp" in told else {}
    changes |= {"env.observation_history": 3} if content == "deployable" else {}
    made = small(robot, walk, **changes)
    folder = tmp_path_factory.mktemp("policy")
    ranges = {"lin_vel_x": (0.0, 1.2), "lin_vel_y": (0.0, 0.0), "ang_vel_z": (-0.8, 0.8)} if told else None
    made.path, *_ = deploy.write(folder, made.policy, robot, made.origin._replace(commands=ranges))
    native = NativePhysics(robot, made.config.physics)
    state = physics.reset(jnp.asarray(robot.default_qpos[None], jnp.float32), jnp.zeros((1, 6 + robot.joint_count)))
    step = jax.jit(native.step)
    command = velocity.make(made.config.command, made.config.control_rate, robot, MotionLibrary.of(walk))
    obeyed = velocity.Velocity(jnp.asarray(TOLD[None], jnp.float32), jnp.array([9]), jnp.zeros((1, 3)))
    if "ramp" in told:
        obeyed = obeyed._replace(value=jnp.zeros((1, 3)), goal=obeyed.value)
    observe = jax.jit(lambda *x: features.observe(robot, *x, features.true_form(made.config)))
    actions = action_map(robot, walk, made.config.env.action)
    sensors = disturbances.make(made.config, robot, actions, 3)
    sensed = sensors and sensors.init(jax.random.PRNGKey(0), 1)
    made.observations, made.states = [], []
    for _ in range(6):
        if sensors:
            seen, sensed = sensors.sense(sensed, state, jnp.asarray(TOLD[None], jnp.float32), jnp.zeros((1, 0)))
            made.observations.append(np.asarray(seen[0]))
        else:
            seen = [observe(state.qpos, state.qvel).actor, *([obeyed.value, obeyed.off] if told else [])]
            made.observations.append(np.concatenate(seen, axis=-1)[0])
        targets = jnp.asarray(made.policy(made.observations[-1])[None])
        if sensors:
            (_, targets), sensed = sensors.act(sensed, state, (targets - actions.center) / actions.scale, None)
        state = step(state, jnp.asarray(targets, jnp.float32))
        obeyed = command.advance(obeyed, None, observe(state.qpos, state.qvel).frame).state
        made.states.append(np.concatenate([state.qpos[0], state.qvel[0]]))
    made.options = {
        "timestep": made.config.physics.timestep,
        "iterations": made.config.physics.iterations,
        "ls_iterations": made.config.physics.ls_iterations,
    }
    return made


@needs_onnx
@pytest.mark.parametrize(
    "edit", [lambda root: None, without_servos, with_weak_motors, in_another_order, without_a_floor, without_a_mesh]
)
def test_the_first_steps_are_those_of_training(trained, robot, tmp_path, edit):
    from fmpjax import sim2sim

    friction = trained.config.physics.frictionloss

    def edited(root):
        root.find("default").find("joint").set("frictionloss", str(friction))
        # Of joint friction the solver's few iterations leave an error, which depends on where they start.
        ElementTree.SubElement(root.find("option"), "flag", warmstart="disable", island="disable")
        edit(root)

    sim = sim2sim.Simulation(sim2sim.load(trained.path), mjcf(robot, tmp_path / "g1.xml", edited, **trained.options))
    sim.command = TOLD
    for observation, state in zip(trained.observations, trained.states, strict=True):
        np.testing.assert_allclose(sim.observe(), observation, atol=1e-5)
        assert not sim.step()
        np.testing.assert_allclose(np.concatenate([sim.qpos, sim.qvel]), state, atol=1e-5)
    said = {
        in_another_order: "the joints are in another order",
        without_a_floor: "no floor: one was added",
        without_a_mesh: "1 mesh files are missing, such as lost.stl: their shapes are left out",
    }
    assert [sentence for sentence in sim.differences if said.get(edit, "nothing") not in sentence] == []
    assert len(sim.differences) == (edit in said)


@pytest.fixture
def exported(robot, walk, tmp_path):
    pytest.importorskip("onnxruntime")
    made = small(robot, walk, **{"physics.timestep": 0.005, "physics.substeps": 4})
    return deploy.write(tmp_path, made.policy, robot, made.origin)[0]


@needs_onnx
def test_what_differs_is_said_and_a_fall_ends_an_episode(exported, robot, tmp_path, capsys):
    def edit(root):
        pelvis = root.find("worldbody").find("body")
        pelvis.find("inertial").set("mass", str(float(pelvis.find("inertial").get("mass")) + 1.5))
        knee = next(joint for joint in root.iter("joint") if joint.get("name") == "left_knee_joint")
        knee.set("range", "0 1")
        knee.set("actuatorfrcrange", "-20 20")
        knee.set("axis", "0 -1 0")
        knee.set("armature", "0.5")
        elbow = next(body for body in root.iter("body") if body.get("name") == "left_elbow_link")
        elbow.set("pos", "0.015783 0 -0.100518")

    path = mjcf(robot, tmp_path / "g1.xml", edit, timestep=0.002, integrator="Euler")
    cli.main(["sim2sim", str(exported), "--model", str(path), "--episodes", "2", "--seconds", "4"])
    printed = capsys.readouterr().out
    assert re.search(r"falls: 2 of 2 episodes, after [0-3]\.\d\d to [0-3]\.\d\d s", printed), printed
    assert "speed: undefined, each episode ends in a fall" in printed
    assert f"mass {robot.total_mass + 1.5:.3f} kg, in training {robot.total_mass:.3f} kg" in printed
    assert "limits of 1 joints, such as left_knee_joint: 0.000 to 1.000 rad, in training" in printed
    assert "lower torque limits of 1 joints, such as left_knee_joint: -20.000 to 20.000 N m" in printed
    assert "time step 2 ms, in training 5 ms" in printed
    assert "directions of 1 joints, left_knee_joint the most: 2.0000 away from those in training" in printed
    assert "places of 4 joints, left_elbow_joint the most: 0.0200 m away from those in training" in printed
    assert "armature of 1 joints, left_knee_joint the most: 0.5 kg m^2, in training 0.0251 kg m^2" in printed
    assert "integrator euler: implicitfast was taken for the servos' damping" in printed


@needs_onnx
def test_bodies_that_hit_each_other_only_here_are_said(exported):
    from fmpjax import sim2sim

    here = resources.folder("robots") / "unitree_g1_29dof" / "robot.xml"
    sim = sim2sim.Simulation(sim2sim.load(exported), here)
    assert "180 pairs of its bodies can hit each other, in training 0" in sim.differences


@pytest.mark.parametrize(
    ("contact", "count"),
    [
        ("", 1),  # the feet; a foot and its own leg are neighbors, and a leg alone collides with nothing
        ('<exclude body1="left" body2="right"/>', 0),
        ('<pair geom1="thigh" geom2="left"/>', 2),
        ('<pair geom1="floor" geom2="left"/>', 1),
    ],
)
def test_pairs_of_bodies_that_hit_each_other_are_counted(contact, count):
    from fmpjax import sim2sim

    foot = '<body name="{0}" pos="0 {1} -1"><joint/><geom name="{0}" size="0.1"/></body>'
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><contact>{contact}</contact><worldbody><geom name="floor" type="plane" size="1 1 1"/>
        <body><freejoint/><geom name="thigh" size="0.1" contype="0" conaffinity="0"/>
        {foot.format("left", 1)}{foot.format("right", -1)}</body></worldbody></mujoco>"""
    )
    assert sim2sim.self_collisions(model) == count


@pytest.mark.parametrize("name", robots.available())
def test_pairs_of_bodies_are_those_that_mujoco_finds_at_any_distance(name):
    from fmpjax import sim2sim

    model = robots.load(name).physics_model()
    model.geom_margin[:] = 100.0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE  # which leaves out pairs by their boxes
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    bodies = model.body_weldid[model.geom_bodyid[data.contact.geom]]
    found = {tuple(sorted(pair)) for pair in bodies.tolist() if 0 not in pair}
    assert sim2sim.self_collisions(model) == len(found)


@needs_onnx
def test_a_model_keeps_the_gains_of_its_own_servos(exported, robot, tmp_path):
    from fmpjax import sim2sim

    def soft(root):
        for servo in root.find("actuator"):
            servo.attrib.update(kp="7", kv="0.5")

    loaded = sim2sim.load(exported)
    sim = sim2sim.Simulation(loaded, mjcf(robot, tmp_path / "soft.xml", soft), own_gains=True)
    assert (sim.model.actuator_gainprm[:, 0] == 7).all()
    assert any(sentence.startswith("stiffness of 29 joints") for sentence in sim.differences)
    assert any(sentence.startswith("damping of 29 joints") for sentence in sim.differences)
    with pytest.raises(UserError, match="none.xml has no position servo on left_hip_pitch_joint"):
        sim2sim.Simulation(loaded, mjcf(robot, tmp_path / "none.xml", without_servos), own_gains=True)


@needs_onnx
def test_what_a_robot_senses_is_what_is_observed(sensed, robot, tmp_path):
    from fmpjax import sim2sim

    sim = sim2sim.Simulation(sim2sim.load(sensed.paths[0]), mjcf(robot, tmp_path / "g1.xml"))
    half = np.sqrt(0.5)
    sim.data.qpos[3:7] = half, 0, half, 0  # wxyz; nose down, so that gravity points along its x axis
    sim.data.qpos[10], sim.data.qvel[3:6], sim.data.qvel[9] = 0.7, (1, 2, 3), -4
    sim.command, sim.action = np.array([0.1, 0.2, 0.3]), np.arange(29.0)
    mujoco.mj_kinematics(sim.model, sim.data)
    parts = np.split(sim.observe(), np.cumsum(list(sensed.terms.values()))[:-1])
    np.testing.assert_allclose(parts[0], [1, 2, 3])
    np.testing.assert_allclose(parts[1], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(parts[2], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(parts[3][3], 0.7 - sensed.policy.center[3], atol=1e-7)
    np.testing.assert_allclose(parts[4][3], -4)
    np.testing.assert_array_equal(parts[5], sim.action)


@needs_onnx
def test_a_course_tells_its_legs_one_after_another(sensed, robot, tmp_path, monkeypatch):
    from fmpjax import sim2sim

    sim = sim2sim.Simulation(sim2sim.load(sensed.paths[0]), mjcf(robot, tmp_path / "g1.xml"))
    told = []
    # A robot that obeys at once.
    monkeypatch.setattr(sim, "velocity", lambda: told.append(sim.command) or sim.command)
    course = sim2sim.course(["0.04:1,0,-0.5", "0.06:0,-0.2,0"])
    played = sim2sim.play(sim, episodes=1, course=course)
    np.testing.assert_array_equal(told, [[1, 0, -0.5]] * 2 + [[0, -0.2, 0]] * 3)
    np.testing.assert_array_equal(played[0].legs, [[1, 0, -0.5], [0, -0.2, 0]])
    velocity = "0.00 m/s forward, -0.20 m/s to the left, 0.00 rad/s"
    assert f"told {velocity} for 0.06 s: {velocity}" in sim2sim.report(sim, played, course)
    monkeypatch.setattr(sim, "step", lambda: sim.time > 0 or setattr(sim, "time", 0.05))
    fell = sim2sim.play(sim, episodes=1, course=course)
    assert fell[0].fell and np.isfinite(fell[0].legs).all(-1).tolist() == [True, False]
    assert "for 0.06 s: nothing, each episode had ended in a fall" in sim2sim.report(sim, fell, course)


@needs_onnx
def test_pushes_come_every_two_seconds_from_any_side(sensed, robot, tmp_path, monkeypatch):
    from fmpjax import sim2sim

    sim = sim2sim.Simulation(sim2sim.load(sensed.paths[0]), mjcf(robot, tmp_path / "g1.xml"))
    sim.push(np.array([0.3, -0.4]))
    np.testing.assert_array_equal(sim.qvel[:6], [0.3, -0.4, 0, 0, 0, 0])
    pushed = []
    monkeypatch.setattr(sim, "step", lambda: setattr(sim, "time", sim.time + 0.02))  # it stands, whatever comes
    monkeypatch.setattr(sim, "push", lambda velocity: pushed.append((round(sim.time, 2), velocity)))
    sim2sim.play(sim, seconds=6.0, episodes=2, push=0.5)
    assert [time for time, _ in pushed] == [2.0, 4.0] * 2
    velocities = np.array([velocity for _, velocity in pushed])
    np.testing.assert_allclose(np.linalg.norm(velocities, axis=1), 0.5)
    assert len(np.unique(velocities[:, 0].round(6))) == 4
    pushed.clear()
    sim2sim.play(sim, seconds=6.0, episodes=1)
    assert not pushed


@needs_onnx
def test_a_push_that_is_no_speed_is_refused(exported, capsys):
    for value in ("-1", "nan"):
        with pytest.raises(SystemExit) as exit_:
            cli.main(["sim2sim", str(exported), "--model", "g1.xml", "--push", value])
        assert exit_.value.code == 2
        assert f"--push is {value}: expected a speed of at least 0" in capsys.readouterr().err


@pytest.mark.parametrize("leg", ["4", "4:1,0", "0:1,0,0", "x:1,0,0", "4:1,0,nan"])
def test_a_leg_that_cannot_be_read_is_refused(leg):
    from fmpjax import sim2sim

    with pytest.raises(UserError, match=f"leg '{leg}' of the course: expected SECONDS:FORWARD,LEFT,TURN"):
        sim2sim.course([leg])


@needs_onnx
def test_a_course_for_a_policy_without_commands_is_refused(exported, robot, tmp_path):
    from fmpjax import sim2sim

    sim = sim2sim.Simulation(sim2sim.load(exported), mjcf(robot, tmp_path / "g1.xml"))
    with pytest.raises(UserError, match="the policy takes no commands: expected no course"):
        sim2sim.play(sim, course=sim2sim.COURSE)


@needs_onnx
def test_a_state_that_blows_up_is_a_fall_and_leaves_numbers(exported, robot, tmp_path):
    from fmpjax import sim2sim

    sim = sim2sim.Simulation(sim2sim.load(exported), mjcf(robot, tmp_path / "g1.xml"))
    act = sim.policy.act
    sim.policy = sim.policy._replace(act=lambda x: act(x) + (np.nan if sim.time > 0.03 else 0.0))
    (episode,) = sim2sim.play(sim, episodes=1)
    assert episode.fell and np.isfinite(episode.qpos).all() and len(episode.qpos) >= 3


@needs_onnx
def test_a_model_or_file_that_does_not_fit_is_refused(exported, robot, tmp_path):
    import onnx

    from fmpjax import sim2sim

    loaded = sim2sim.load(exported)
    for path, sentence in (
        (tmp_path / "none.xml", r"^\S*none.xml cannot be read as MJCF: "),
        (
            resources.folder("robots") / "strider" / "robot.xml",
            "robot.xml has no hinge waist_yaw_joint, .* and 14 more: the policy",
        ),
        (mjcf(robot, tmp_path / "slow.xml", timestep=0.05), "has a time step of 0.05 s: expected at most 0.02 s"),
    ):
        with pytest.raises(UserError, match=sentence):
            sim2sim.Simulation(loaded, path)
    with pytest.raises(UserError, match="is not a file: expected policy.onnx"):
        sim2sim.load(tmp_path / "none.onnx")
    (tmp_path / "text.onnx").write_text("text")
    with pytest.raises(UserError, match="text.onnx is not an ONNX file"):
        sim2sim.load(tmp_path / "text.onnx")
    for key, value, sentence in (
        ("action_scale", None, "has no metadata 'action_scale'"),
        ("action_scale", "1,nan", "'1,nan' is not finite"),
        ("action_scale", "1,1", "has 2 values of scale: expected 29, one per joint"),
        ("joint_loads", "1,1", "has 2 values of joint_loads: expected 29, one per joint"),
        ("key_points", "[1]", "has metadata that cannot be read"),
        ("observation_terms_scale", "1.0,2.0", "observation_terms_scale is 2.0, and sim2sim knows only 1.0"),
        ("step_dt", "often", "has metadata that cannot be read"),
        ("command_ramp", "1;0;1", r"has command_ramp \[1.0, 0.0, 1.0\]: expected three numbers above 0"),
        ("observation_names", "a,b,c,d,e,f,g", "observes 'a', which sim2sim does not know"),
        ("observation_widths", "1,6,3,3,29,29,16", r"its metadata says \[1, 87\] to \[1, 29\]"),
    ):
        model = onnx.load(exported)
        for entry in list(model.metadata_props):
            if entry.key == key and value is None:
                model.metadata_props.remove(entry)
            elif entry.key == key:
                entry.value = value
        onnx.save(model, tmp_path / "other.onnx")
        with pytest.raises(UserError, match=sentence):
            sim2sim.load(tmp_path / "other.onnx")
    model = onnx.load(exported)
    model.graph.input[0].name = model.graph.node[0].input[0] = "actor_obs"
    onnx.save(model, tmp_path / "other.onnx")
    with pytest.raises(UserError, match="maps actor_obs to actions: expected obs to actions"):
        sim2sim.load(tmp_path / "other.onnx")
    exchanged = loaded._replace(terms=loaded.terms | {"root_height": 3, "root_linear_velocity": 1})
    with pytest.raises(UserError, match="the policy's root_height has 3 numbers: expected 1"):
        sim2sim.Simulation(exchanged, mjcf(robot, tmp_path / "g1.xml"))


@needs_onnx
def test_sim2sim_runs_without_jax(exported, robot, tmp_path):
    command = ["sim2sim", str(exported), "--model", str(mjcf(robot, tmp_path / "g1.xml"))]
    command += ["--episodes", "1", "--seconds", "0.1"]
    code = (
        f"import sys; from fmpjax import cli; cli.main({command});"
        "print(sorted({'jax', 'flax', 'onnx'} & {name.split('.')[0] for name in sys.modules}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=240)
    assert done.stdout.endswith("\n[]\n") and "falls: " in done.stdout, done.stdout + done.stderr

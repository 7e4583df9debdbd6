"""Robots in real time: the session without a browser, the policies of a run, and the server of the page."""

import asyncio
import importlib.util
import json
import os
import subprocess
import sys
import threading
import time
import urllib.request
from types import SimpleNamespace

import glfw
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from fmpjax import cli, config, motion, play, policy, robots, sim2sim
from fmpjax.commands import phase as phases
from fmpjax.config import preset
from fmpjax.errors import UserError
from fmpjax.frames import FrameLayout
from fmpjax.motion import MotionLibrary
from fmpjax.play.devices import Gamepad, Keyboard
from fmpjax.play.player import Drag, Player, moved
from fmpjax.sim2sim import ExportedPolicy

serving = pytest.importorskip("fmpjax.play.server", reason="the extra play", exc_type=ImportError)

HOLD = np.array([[-0.5, 0.0, -0.8], [1.0, 0.0, 0.8]])  # what the test's policies may be told


def said(robot, terms, *, rate=50.0, joints=None):
    """The metadata of a policy that observes ``terms`` and holds the default pose."""
    names = robot.joint_names if joints is None else joints
    facts = sim2sim.facts(robot.model, names)

    def listed(values):
        return ",".join(";".join(map(str, np.ravel(value))) for value in values)

    ones = ",".join(["1.0"] * len(terms))
    count = len(names)
    return {
        "observation_names": ",".join(terms),
        "observation_widths": listed(terms.values()),
        "observation_terms_scale": ones,
        "observation_terms_clip": ",".join(["-inf;inf"] * len(terms)),
        "observation_terms_history_length": ",".join(["0"] * len(terms)),
        "joint_names": ",".join(names),
        "action_offset": listed(robot.default_qpos[7 : 7 + count]),
        "action_scale": listed([1.0] * count),
        "joint_stiffness": listed(robot.stiffness[:count]),
        "joint_damping": listed(robot.damping[:count]),
        "joint_effort": listed(robot.effort[:count]),
        "joint_limits": listed(np.stack([robot.joint_low, robot.joint_high], -1)[:count]),
        "joint_axes": listed(robot.joint_axis[:count]),
        "jointless_row": "",
        "default_qpos": listed(robot.default_qpos[: 7 + count]),
        "key_points": "[]",
        "fall_shapes": json.dumps(
            [{"body": "torso_link", "joint": None, "ends": [[0, 0, 0], [0, 0, 0]], "radius": 0.4}]
        ),
        "step_dt": str(1 / rate),
        "physics_dt": "0.005",
        "total_mass": str(robot.total_mass),
        "integrator": "implicitfast",
        **{name: listed(facts[name]) for name in sim2sim.FACTS},
        "robot": robot.name,
        "command_ranges": listed(HOLD.T) if "velocity_commands" in terms else "",
    }


def standing(robot, *, steered=True, **changes) -> ExportedPolicy:
    """A policy that holds the default pose; its second observation is what it was told."""
    terms = {"root_height": 1} | ({"velocity_commands": 3} if steered else {})
    size = sum(terms.values())
    return sim2sim.read(
        "held",
        said(robot, terms, **changes),
        lambda x: np.zeros(robot.joint_count),
        ((1, size), (1, robot.joint_count)),
    )


def player(robot, label="held", clips=(), **changes) -> Player:
    simulation = sim2sim.Simulation(standing(robot, **changes), robot.path, model=robot.model)
    return Player(label, simulation, clips)


@pytest.fixture
def session(robot):
    return play.Session([player(robot)])


# --- the session -----------------------------------------------------------------------------------------------------


def test_a_command_reaches_the_policy_and_stays_within_its_range(session):
    seen = []
    sim = session.players[0].simulation
    session.use(0, sim.policy._replace(act=lambda x: seen.append(x) or np.zeros(29)))
    np.testing.assert_array_equal(session.commands, HOLD)
    np.testing.assert_array_equal(session.tell(np.array([0.7, 0.4, -2.0])), [0.7, 0.0, -0.8])
    session.tick()
    np.testing.assert_allclose(seen[-1][1:], [0.7, 0.0, -0.8])
    np.testing.assert_array_equal(session.tell(np.array([np.nan, 0.0, 0.0])), [0.7, 0.0, -0.8])
    np.testing.assert_array_equal(session.players[0].rows[-1].command, [0.7, 0.0, -0.8])


def test_a_policy_without_commands_is_told_none(robot):
    alone = play.Session([player(robot, steered=False)])
    assert alone.commands is None
    np.testing.assert_array_equal(alone.tell(np.ones(3)), np.zeros(3))


def test_a_policy_that_is_told_the_time_in_a_clip_sees_it_as_in_training(robot, walk):
    """Row for row what the command of the training shows, and again from a new row at the clip's end."""
    terms, seen = {"clip_phase": 5 + robot.joint_count}, []

    def act(observation):
        seen.append(observation)
        return np.zeros(robot.joint_count)

    learned = sim2sim.read("timed", said(robot, terms), act, ((1, 5 + robot.joint_count), (1, robot.joint_count)))
    poses = walk.qpos[:, 7:]
    played = Player("timed", sim2sim.Simulation(learned, robot.path, model=robot.model, poses=poses), (walk,))
    first, seen[:] = played.simulation.row, []
    command = phases.make(robot, MotionLibrary.of(walk), jnp.zeros((len(walk) + 1, FrameLayout.of(robot).size)), 1)
    for _ in range(len(walk) - 1 - first):
        assert played.simulation.row == played.ghost.row and not played.simulation.over
        played.step(np.zeros(3), 0.0, stand_up=False)
    expected = command.observe(jnp.arange(first, len(walk) - 1))
    np.testing.assert_allclose(np.array(seen), expected, atol=1e-5)
    assert played.simulation.row < len(walk) // 2 and played.falls in (0, 1)
    with pytest.raises(UserError, match="its file has no clip: expected its run"):
        sim2sim.Simulation(learned, robot.path, model=robot.model)


def test_a_push_gives_the_robot_its_impulse(robot, session):
    session.tick()
    sim = session.players[0].simulation
    turn = np.array([np.cos(np.pi / 4), 0, 0, np.sin(np.pi / 4)])  # it faces +y, wxyz
    sim.place(np.concatenate([sim.qpos[:3] + [0, 0, 1], turn, sim.qpos[7:]]), np.zeros(35))  # where nothing holds it
    session.push(np.array([20.0, 10.0]))
    for _ in range(6):
        session.tick()
    mujoco.mj_subtreeVel(sim.model, sim.data)
    velocity = sim.data.subtree_linvel[sim.root_body]
    np.testing.assert_allclose(velocity[:2], np.array([-10.0, 20.0]) / robot.total_mass, atol=0.02)


def test_a_hand_pulls_toward_the_pointer(session):
    sim = session.players[0].simulation
    before = sim.qpos[0]
    body = sim.root_body
    session.drag(0, Drag(body, np.zeros(3), sim.data.xpos[body] + [0.4, 0, 0]))
    for _ in range(15):
        session.tick()
    assert sim.qpos[0] > before + 0.02
    session.drag(0, None)
    session.tick()
    assert not sim.data.xfrc_applied.any()


def test_a_paused_session_stands_still_and_goes_on(session):
    stop = threading.Event()
    clock = threading.Thread(target=session.run, args=(stop,))
    session.pause(True)
    clock.start()
    time.sleep(0.15)
    assert session.time == 0.0
    session.pause(False)
    time.sleep(0.5)
    session.pause(True)
    time.sleep(0.1)
    here = session.time
    time.sleep(0.15)
    stop.set()
    clock.join()
    assert 0.0 < here <= 0.7 and session.time == here and session.steps == round(here / session.dt)


def test_slow_motion_takes_longer(session, monkeypatch):
    now = [0.0]
    stop = threading.Event()
    monkeypatch.setattr("fmpjax.play.session.time.perf_counter", lambda: now[0])
    monkeypatch.setattr("fmpjax.play.session.time.sleep", lambda s: now.__setitem__(0, now[0] + s))
    monkeypatch.setattr(session, "tick", lambda: stop.set() if session.steps == 49 else None)
    session.slow(0.25)
    session.run(stop)
    assert now[0] == pytest.approx(50 * 0.02 / 0.25) and session.late == 0
    session.slow(7.0)
    assert session.pace == 1.0


def test_a_late_tick_is_counted_and_lost_time_is_not_run_after(session, monkeypatch):
    now, slept = [0.0], []
    stop = threading.Event()

    def tick():
        now[0] += 1.0 if session.steps == 3 else 0.001
        if session.steps == 9:
            stop.set()

    monkeypatch.setattr("fmpjax.play.session.time.perf_counter", lambda: now[0])
    monkeypatch.setattr("fmpjax.play.session.time.sleep", lambda s: slept.append(s) or now.__setitem__(0, now[0] + s))
    monkeypatch.setattr(session, "tick", tick)
    session.run(stop)
    assert (session.steps, session.late) == (10, 1) and session.worst == pytest.approx(0.98)
    np.testing.assert_allclose(slept, 0.019)


def test_reset_puts_robots_at_their_starts(session):
    one = session.players[0]
    start = one.simulation.qpos
    session.push(np.array([50.0, 0.0]))
    for _ in range(20):
        session.tick()
    assert np.abs(one.simulation.qpos - start).max() > 0.05
    session.reset()
    np.testing.assert_allclose(one.simulation.qpos, start, atol=1e-9)


def test_a_robot_that_fell_stands_up_where_it_is(session):
    one = session.players[0]
    session.push(np.array([60.0, 0.0]))
    for _ in range(400):
        session.tick()
        if one.lies:
            break
    assert one.falls == 1
    place = one.simulation.qpos[:2]
    session.stand_up = False
    for _ in range(100):
        session.tick()
    assert one.lies and one.falls == 1
    session.stand_up = True
    session.tick()
    assert not one.lies and one.simulation.qpos[2] > 0.7
    assert np.linalg.norm(one.simulation.qpos[:2] - place) < 1.0 and np.linalg.norm(place) > 0.1


def test_a_state_that_blows_up_begins_again(session, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes of it
    one = session.players[0]
    one.simulation.data.qvel[0] = np.nan
    session.tick()
    assert np.isfinite(one.simulation.qpos).all() and one.falls == 1
    session.tick()
    assert one.falls == 1 and one.simulation.time == pytest.approx(0.02)


def test_policies_of_other_robots_and_rates_are_refused(robot, session):
    strider = robots.load("strider")
    with pytest.raises(UserError, match="the policy moves strider at 50 Hz: expected one of unitree_g1 at 50 Hz"):
        session.use(0, session.players[0].simulation.policy._replace(joint_names=strider.joint_names, robot="strider"))
    with pytest.raises(UserError, match="held acts at 50 Hz and other at 25 Hz: expected policies with the same rate"):
        play.Session([player(robot), player(robot, "other", rate=25.0)])
    with pytest.raises(UserError, match="there is nothing to play"):
        play.Session([])


def test_players_stand_side_by_side_under_one_command(robot):
    both = play.Session([player(robot), player(robot, "other")])
    both.tell(np.array([0.3, 0.0, 0.0]))
    both.push(np.array([0.0, 30.0]), player=1)
    for _ in range(10):
        both.tick()
    first, second = (one.simulation for one in both.players)
    assert abs(first.qpos[1]) < 0.01 < second.qpos[1]
    np.testing.assert_array_equal(first.command, second.command)


# --- the demonstration -----------------------------------------------------------------------------------------------


def test_a_configuration_is_moved_over_the_floor_and_turned(walk):
    here = walk.qpos[10].copy()
    quarter = np.array([np.cos(np.pi / 4), 0, 0, np.sin(np.pi / 4)])
    place = np.concatenate([[3.0, 4.0, 9.0], quarter, here[7:]])
    np.testing.assert_allclose(moved(walk.qpos[0], walk.qpos[0], walk.qpos[0]), walk.qpos[0], atol=1e-12)
    there = moved(here, walk.qpos[0], place)
    way = here[:2] - walk.qpos[0, :2]
    angle = np.pi / 2 - 2 * np.arctan2(walk.qpos[0, 6], walk.qpos[0, 3])
    turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ way
    np.testing.assert_allclose(there[:2], [3.0, 4.0] + turned, atol=2e-3)
    assert there[2] == here[2] and (there[7:] == here[7:]).all()


def test_the_demonstration_that_moves_like_the_command_goes_along(robot):
    clips = tuple(motion.load(name) for name in ("walk", "turn_left"))
    one = player(robot, clips=clips)
    fast, turning = (clip.heading_velocities.mean(0) for clip in clips)
    one.restart(fast)
    assert one.ghost.clip is clips[0]
    np.testing.assert_allclose(one.ghost.qpos(), one.simulation.qpos, atol=1e-9)
    np.testing.assert_allclose(one.simulation.qpos[:2], 0.0, atol=1e-9)
    np.testing.assert_allclose(one.simulation.qvel[6:], clips[0].qvel[one.ghost.first, 6:])
    assert one.simulation.velocity()[0] == pytest.approx(fast[0], abs=0.3)
    one.step(turning, 0.02)
    assert one.ghost.clip is clips[1]
    one.ghost.row = len(clips[1]) + 1.0  # at its end it begins again, at the robot
    one.step(turning, 0.04)
    assert one.ghost.row == 0
    np.testing.assert_allclose(one.ghost.qpos()[:2], one.simulation.qpos[:2], atol=1e-9)


# --- where policies come from ----------------------------------------------------------------------------------------


def saved(path, robot, bias=0.0, moves=None):
    """A file of a policy whose joints stand ``bias`` rad off the default pose."""
    terms = {"root_height": 1, "velocity_commands": 3}
    center = robot.default_qpos[7:].astype(np.float32)
    held = policy.Policy(
        robot.joint_names, "none", 50.0, "relu", (np.zeros((4, 29)),), (np.full(29, bias),), np.zeros(4), np.ones(4),
        5.0, center, np.ones(29, np.float32), center - 1, center + 1,
    )  # fmt: skip
    return policy.save(path, held, said(robot, terms) | {"robot": moves or robot.name})


@pytest.fixture
def run(tmp_path, robot, walk, monkeypatch):
    """A run with checkpoints, whose reader gives policies of a known bias: the iteration over 1000."""
    folder = tmp_path / "run"
    for name in ("checkpoints/100", "checkpoints/200", "checkpoints/300.orbax-tmp", "best/100"):
        (folder / name).mkdir(parents=True)
    (folder / "config.json").write_text(config.to_json(preset("smoke", motion="walk")))
    motion.save(walk, folder / "demonstration.npz")
    (tmp_path / "read").mkdir()

    def read(reader, iteration, *, best=False):
        return saved(tmp_path / "read" / f"{iteration}.npz", robot, iteration / 1000)

    monkeypatch.setattr("fmpjax.play.reader.Reader.policy", read)
    monkeypatch.setattr("fmpjax.play.reader.Reader.score", lambda reader, qpos, qvel: (float(len(qpos)), 2.0))
    return folder


def test_a_run_offers_its_checkpoints_and_new_ones(run, robot):
    source = play.source_of(run)
    assert source.names() == ["best", "newest", "200", "100"] and source.first == "best"
    assert [source.version(name) for name in ("best", "newest", "100", "300", "../100", "live")] == [
        "100", "200", "100", None, None, None,
    ]  # fmt: skip
    (run / "checkpoints" / "400").mkdir()
    assert source.names()[1:3] == ["newest", "400"] and source.version("newest") == "400"
    assert source.load("newest").act(np.zeros(4))[0] == pytest.approx(0.4)
    assert source.load("100").act(np.zeros(4))[0] == pytest.approx(0.1)
    for name in ("../best", "/etc/passwd", "300", ""):
        with pytest.raises(UserError, match="has no policy .*: expected one of best, newest, 400, 200, 100"):
            source.load(name)


def test_a_run_is_played_in_the_physics_of_its_training(run):
    source = play.source_of(run, name="100")
    one = source.player(source.load("100"))
    option, physics = one.simulation.model.opt, source.config.physics
    assert (option.timestep, option.iterations) == (physics.timestep, physics.iterations)
    assert one.simulation.substeps == physics.substeps and one.clips[0].rate == 50.0
    assert source.score(*np.zeros((2, 12, 3))) == (float(source.horizon), 2.0)
    assert source.score(*np.zeros((2, 3, 3))) is None  # fewer states than the prior looks at


def test_the_live_policy_is_read_from_its_file(run, robot):
    saved(run / policy.LIVE, robot, 0.25)
    source = play.source_of(run, name="live")
    first = source.version("live")
    assert source.load("live").act(np.zeros(4))[0] == pytest.approx(0.25)
    assert source.score(*np.zeros((2, 12, 3))) is None  # its prior is in no file
    saved(run / policy.LIVE, robot, 0.5)
    assert source.version("live") != first


def test_what_cannot_be_played_is_refused(run, robot, tmp_path):
    for arguments, sentence in (
        ({"path": tmp_path / "none"}, "none cannot be played: expected a run folder, policy.onnx or policy.npz"),
        ({"path": tmp_path}, "is no run folder: expected config.json in it, or policy.npz or policy.onnx"),
        ({"path": run, "name": "7"}, "has no policy '7': expected one of best, newest, 200, 100"),
        ({"path": run, "model": tmp_path / "a.xml"}, "--model goes with the file of a policy"),
        ({"path": saved(tmp_path / "a.npz", robot), "name": "best"}, "--checkpoint goes with a run"),
    ):
        with pytest.raises(UserError, match=sentence):
            play.source_of(**arguments)
    for name in ("checkpoints", "best"):
        for path in (run / name).iterdir():
            path.rmdir()
    with pytest.raises(UserError, match="has no checkpoint: train the run first"):
        play.source_of(run)


def test_the_file_of_a_policy_stands_on_its_robot_or_another_model(robot, tmp_path):
    source = play.source_of(saved(tmp_path / "policy.npz", robot))
    one = source.player(source.load("policy.npz"))
    assert one.simulation.model.opt.timestep == 0.005 and one.clips == () and source.names() == ["policy.npz"]
    other = play.source_of(tmp_path / "policy.npz", model=robots.load("strider").path)
    with pytest.raises(UserError, match="robot.xml has no hinge .*: the policy moves unitree_g1"):
        other.player(other.load("policy.npz"))
    strange = play.source_of(saved(tmp_path / "b.npz", robot, moves="strider"))
    with pytest.raises(UserError, match="moves other joints than strider has: name its model with --model"):
        strange.player(strange.load("b.npz"))
    policy.save(tmp_path / "c.npz", policy.load(tmp_path / "b.npz"))
    with pytest.raises(UserError, match="c.npz does not say what its robot is: expected policy.npz"):
        play.source_of(tmp_path / "c.npz").load("c.npz")


def test_no_pickle_is_loaded(robot, tmp_path):
    with np.load(saved(tmp_path / "policy.npz", robot)) as file:
        arrays = dict(file)
    for name in ("metadata", "observation"):
        np.savez(tmp_path / "evil.npz", **arrays | {name: np.array({"a": 1}, dtype=object)})
        with pytest.raises(UserError, match="evil.npz is not a policy .*allow_pickle=False"):
            play.source_of(tmp_path / "evil.npz").load("evil.npz")


# --- the page --------------------------------------------------------------------------------------------------------

needs_viser = pytest.mark.skipif(not importlib.util.find_spec("viser"), reason="the extra play is not installed")


@pytest.fixture
def page(run, robot, tmp_path):
    """A page of two policies on a free port; its robots are moved by the test alone."""
    from fmpjax.play.page import Page

    file = saved(tmp_path / "policy.npz", robot)
    opened = Page([play.source_of(run), play.source_of(file)], port=0)
    opened.session.pause(True)
    yield opened
    opened.close()


def waited(true):
    for _ in range(200):
        if true():
            return True
        time.sleep(0.02)
    return False


@needs_viser
def test_a_page_is_served_on_this_machine_alone(page):
    from fmpjax.play.page import address

    with urllib.request.urlopen(address(page.server), timeout=10) as answer:
        assert answer.status == 200 and b"<html" in answer.read()
    assert page.server.get_host() == "127.0.0.1" and page.server.request_share_url() is None
    port = page.server.get_port()
    with pytest.raises(
        UserError, match=rf"no page at 127.0.0.1:{port} \(Address already in use\): name another --port"
    ):
        serving.start("other", port=port)
    with pytest.raises(UserError, match="no page at 192.0.2.1:0 .*: name another --port, .*, and an address of this"):
        serving.start("other", host="192.0.2.1", port=0)
    with pytest.raises(UserError, match="--port is 70000: expected 0 to 65535"):
        serving.start("other", port=70000)


@needs_viser
def test_a_taken_port_is_refused_before_policies_are_read(page, run, monkeypatch):
    from fmpjax.play.page import Page

    monkeypatch.setattr("fmpjax.play.reader.Reader.policy", lambda *_, **__: pytest.fail("it was read"))
    with pytest.raises(UserError, match="Address already in use"):
        Page([play.source_of(run)], port=page.server.get_port())


@needs_viser
def test_the_controls_stand_beside_the_robot(page, monkeypatch):
    """Where they float they hide it on a small screen."""
    docked = []
    monkeypatch.setattr(type(page.server.gui.main_panel), "dock_right", lambda panel: docked.append(panel))
    serving.start("other", port=0).stop()
    assert len(docked) == 1


@needs_viser
def test_the_scores_curve_shows_the_last_seconds(page):
    for i in range(30):
        page.plots.add_score(i / 2, (1.0, 2.0), 3.0)
    for _ in range(2):
        page.session.tick()
    page.plots.update()
    drawn = page.plots.score._handle.data[0]
    assert (drawn[0], drawn[-1], len(drawn)) == (5.0, 14.5, 20)


@needs_viser
def test_the_controls_do_what_they_say(page):
    session, panel = page.session, page.panel
    assert list(panel._sliders) == [0, 2]  # the policies were told nothing sideways
    panel._tell(0, 0.4)
    panel._tell(2, 9.0)
    np.testing.assert_array_equal(session.command, [0.4, 0.0, 0.8])
    assert panel._sliders[2].value == 0.8
    panel._stand()
    np.testing.assert_array_equal(session.command, np.zeros(3))
    panel._push("nowhere")
    panel._push("left")
    for _ in range(8):
        session.tick()
    assert all(one.simulation.qvel[1] > 0.2 for one in session.players)
    panel._toggle()
    assert not session.paused
    panel._toggle()
    page.view.update(0.04)
    page.plots.update()
    panel.update()
    assert "**run** best" in panel._status.content and "50 Hz" in panel._status.content
    page.view.ghosts(False)
    assert not any(batch.handle.visible for batch in page.view._shown[0].ghost.batches)


@needs_viser
def test_keys_at_once_all_count(page):
    threads = [threading.Thread(target=page.panel._tell, args=(0, 0.01), kwargs={"more": True}) for _ in range(20)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert page.session.command[0] == pytest.approx(0.2)


@needs_viser
def test_the_mouse_pulls_where_it_holds_the_robot_and_lets_go(page):
    """In the order of its events: viser awaits coroutines, and runs plain functions side by side."""
    player, (batch, *_) = page.session.players[0], page.view._shown[0].robot.batches
    page.view.update(0.04)
    (entry,) = batch.handle._impl.drag_cb
    lane = page.view._lanes[0] - page.view._middle
    body = int(player.simulation.model.geom_bodyid[batch.geoms[1]])
    held = player.simulation.data.xpos[body] + [0.0, 0.0, 0.02]

    def drag(phase, away=0.0):
        places = {"start_position": tuple(held + lane), "end_position": tuple(held + lane + [away, 0.0, 0.0])}
        asyncio.run(entry.callback(SimpleNamespace(phase=phase, instance_index=1, **places)))
        return player.drag

    drags = drag("start"), drag("update", 0.3), drag("end")
    assert drags[0].body == drags[1].body == body and drags[2] is None
    np.testing.assert_allclose(drags[1].target - drags[0].target, [0.3, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(
        player.simulation.data.xmat[body].reshape(3, 3) @ drags[0].point, [0.0, 0.0, 0.02], atol=1e-9
    )
    assert page.session.players[1].drag is None
    drag("start")
    page.session.reset()
    assert drag("update", 0.3) is None  # it has slipped from the hand


@needs_viser
def test_a_page_hops_between_checkpoints_and_finds_new_ones(page, run):
    def bias():
        return page.session.players[0].simulation.policy.act(np.zeros(4))[0]

    panel, loader = page.panel, page.loader
    assert bias() == pytest.approx(0.1)
    panel._policies[0].value = "200"
    assert waited(lambda: bias() == pytest.approx(0.2)) and waited(lambda: loader.said[0] == "")
    panel._policies[0].value = "newest"
    assert waited(lambda: loader.names[0] == "newest" and loader.said[0] == "")
    (run / "checkpoints" / "500").mkdir()
    loader.look()
    assert waited(lambda: bias() == pytest.approx(0.5))
    panel.update()
    assert "500" in panel._policies[0].options
    loader.ask(0, "../../secret")
    assert waited(lambda: "has no policy '../../secret'" in loader.said[0]) and bias() == pytest.approx(0.5)


@needs_viser
def test_a_motion_is_shown_with_its_check(robot, walk):
    from fmpjax.motion import check
    from fmpjax.play.clip import ClipPage, verdicts

    page = ClipPage(robot, walk, port=0)
    try:
        page.update(0.5)
        assert page.time == pytest.approx(0.5) and page._slider.value == pytest.approx(0.5)
        np.testing.assert_allclose(page._figure.data.qpos, walk.qpos[25])
        page._joint.value = "left_knee"
        page.update(walk.duration)
        assert page.time == pytest.approx(0.5)
        drawn = page._angle._handle.data
        assert robot.joint_low[robot.joint_names.index("left_knee_joint")] == drawn[2][0]
    finally:
        page.server.stop()
    figures = [check.Figure("speed", 0.9), check.Figure("penetration", 0.5, "at 1.00 s")]
    assert verdicts(figures).splitlines()[0] == "✗ **penetration** 0.5 m (at 1.00 s)  "


@needs_viser
def test_a_page_ends_with_the_training_that_opened_it(robot, tmp_path, capsys):
    file = saved(tmp_path / "policy.npz", robot)
    play.serve([play.source_of(file)], host="127.0.0.1", port=0, parent=os.getppid() + 1)  # no parent of this process
    assert "open http://localhost:" in capsys.readouterr().out


def test_what_does_not_go_together_is_refused(run, robot, tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    file = str(saved(tmp_path / "policy.npz", robot))
    for arguments, sentence in (
        (["play"], "there is nothing to play"),
        (
            ["play", str(run), "--native"],
            "--native opens a window, and there is no display: without one, `fmpjax play`",
        ),
        (["play", str(run), file, "--native"], "--native shows one robot: expected one run or policy, not 2"),
        (["play", str(run), "--gamepad"], "--gamepad goes with --native"),
        (["sim2sim", file, "--model", file, "--keyboard"], "--keyboard opens a window, and there is no display"),
        (["sim2sim", file, "--model", file, "--gamepad"], "--gamepad opens a window, and there is no display"),
        (
            ["sim2sim", file, "--model", file, "--keyboard", "--course", "1:1,0,0"],
            "expected no --course, no --push and no --video",
        ),
        (["motion", "view", "walk", "--browser", "--out", "a.png"], "--browser and --out do not go together"),
    ):
        with pytest.raises(SystemExit) as ended:
            cli.main(arguments)
        assert ended.value.code == 2 and sentence in capsys.readouterr().err, arguments


def test_a_missing_package_is_named_with_its_extra(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"a page needs the package viser, .*: install the extra fmpjax\[play\]"):
        play.check_installed()
    play.check_installed(page=False)


# --- keyboard and gamepad --------------------------------------------------------------------------------------------


def test_keys_of_the_viewer_command_push_pause_and_reset(session):
    press = Keyboard(session)
    for key in (glfw.KEY_UP, glfw.KEY_UP, glfw.KEY_LEFT):
        press(key)
    np.testing.assert_allclose(session.command, [0.2, 0.0, 0.1])
    press(glfw.KEY_END)
    np.testing.assert_array_equal(session.command, np.zeros(3))
    press(glfw.KEY_SPACE)
    assert session.paused
    press(glfw.KEY_KP_4)
    for _ in range(6):
        session.tick()
    assert session.players[0].simulation.qvel[1] > 0.2
    press(glfw.KEY_ENTER)
    assert not session.players[0].simulation.qvel.any()


def test_a_gamepad_walks_turns_and_resets(session):
    state = SimpleNamespace(axes=[0.0] * 6, buttons=[0] * 15)
    pad = Gamepad(session, lambda: state)
    state.axes[glfw.GAMEPAD_AXIS_LEFT_Y], state.axes[glfw.GAMEPAD_AXIS_RIGHT_X] = -0.5, 1.0
    pad.poll()
    np.testing.assert_allclose(session.command, [0.5, 0.0, -0.8])
    state.axes[glfw.GAMEPAD_AXIS_LEFT_Y] = 0.05  # a stick that does not quite rest
    pad.poll()
    np.testing.assert_allclose(session.command, [0.0, 0.0, -0.8])
    session.push(np.array([30.0, 0.0]))
    for _ in range(5):
        session.tick()
    moving = session.players[0].simulation.qvel[0]
    state.buttons[glfw.GAMEPAD_BUTTON_A] = 1
    pad.poll()
    assert moving > 0.1 and session.players[0].simulation.qvel[0] == 0
    session.tick()
    pad.poll()  # held on, it does not reset again
    assert session.players[0].simulation.time > 0
    pad = Gamepad(session, lambda: None)  # unplugged
    pad.poll()
    np.testing.assert_array_equal(session.command, np.zeros(3))


def test_play_starts_without_jax(robot, tmp_path):
    path = saved(tmp_path / "policy.npz", robot)
    code = (
        "import sys; from pathlib import Path; from fmpjax import play, cli;"
        f"source = play.source_of(Path({str(path)!r}));"
        "session = play.Session([source.player(source.load('policy.npz'))]);"
        "session.tick(); print(sorted({'jax', 'flax', 'orbax'} & {name.split('.')[0] for name in sys.modules}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=240)
    assert done.stdout == "[]\n", done.stdout + done.stderr

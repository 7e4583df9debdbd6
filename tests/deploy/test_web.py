"""The page of a policy: its files, what is refused, and its robot against sim2sim's, in Node.js and in a browser."""

import base64
import contextlib
import hashlib
import http.server
import importlib.util
import io
import json
import re
import shutil
import subprocess
import tarfile
import threading
from functools import partial

import mujoco
import numpy as np
import pytest

from fmpjax import cli, config, deploy, resources, robots, runs, sim2sim
from fmpjax.config import preset
from fmpjax.deploy import packages, web
from fmpjax.errors import UserError
from fmpjax.physics import native
from tests.helpers import small_policy

pytestmark = pytest.mark.skipif(
    not all(importlib.util.find_spec(name) for name in ("onnx", "onnxruntime")),
    reason="the extra deploy is not installed",
)
STEERED = {"env.observation": "compact", "env.axes": "heading", "command.kind": "velocity"}
RANGES = {"lin_vel_x": (0.0, 1.2), "lin_vel_y": (0.0, 0.0), "ang_vel_z": (-0.8, 0.8)}
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
TOLD = [0.5, 0.0, -0.3]  # m/s ahead and to the left, rad/s
CLOSE = 1e-5  # rad, m and their rates: how far the page's robot may be from sim2sim's after STEPS steps of control
STEPS = 10


def others():
    """Stand-ins for the programs of others."""
    found = {f"lib/{short}/{name}": b"" for short, package in packages.PACKAGES.items() for name in package.files}
    return found | {"lib/README.md": b""}


def written(folder, robot, walk, **changes):
    """A page of a small policy that is told velocities."""
    made = small_policy(robot, walk, **(STEERED | {"physics.threads": 1} | changes))
    deploy.write_page(folder, made.policy, robot, made.origin._replace(commands=RANGES))
    return made


@pytest.fixture
def page(tmp_path, robot, walk, monkeypatch):
    monkeypatch.setattr(packages, "collect", others)
    made = written(tmp_path / "page", robot, walk)
    made.folder = tmp_path / "page"
    return made


# --- the files -------------------------------------------------------------------------------------------------------


def test_all_that_the_page_asks_for_is_there_and_nothing_of_elsewhere(page):
    names = {path.relative_to(page.folder).as_posix() for path in page.folder.rglob("*") if path.is_file()}
    asked = set()
    for path in page.folder.iterdir():
        if path.suffix not in (".html", ".css", ".js"):
            continue
        text = path.read_text()
        assert not re.search(r"\w+://|[\"'(]//|(?:src|href)=\"/|from \"/", text), path.name
        asked.update(re.findall(r"(?:src|href)=\"([^\"#:]+)\"", text))
        asked.update(re.findall(r"\"(?:\./)?([\w/-]+(?:\.\w+)?\.(?:js|wasm|onnx|xml))\"", text))
    assert {"main.js", "page.css", "view.js", "policy.onnx", "model.xml", "MODEL_CARD.md"} <= asked
    # MuJoCo's program finds the file beside it, three.module.js the other half of three.
    beside = {"lib/mujoco/mujoco.wasm", "lib/three/three.core.js"}
    assert asked | beside <= names
    assert names - asked - beside == {"index.html", "lib/README.md", "lib/three/LICENSE"}
    assert page.folder.stat().st_mode & 0o055 == 0o055, "a file server may not read it"


def test_the_browser_takes_the_map_of_imports(page):
    """Its content-security policy names what stands between the tags."""
    text = (page.folder / "index.html").read_text()
    imports = re.search(r"<script type=\"importmap\">(.*?)</script>", text, re.DOTALL)[1]
    assert base64.b64encode(hashlib.sha256(imports.encode()).digest()).decode() in text
    assert json.loads(imports)["imports"].keys() == {"three"}


def test_the_page_knows_the_observations_that_sim2sim_knows(page):
    code = (page.folder / "observation.js").read_text().split("TERMS = {")[1]
    assert re.findall(r"^  (\w+):", code, re.MULTILINE) == list(sim2sim.TERMS)


def test_the_policys_file_is_as_everywhere_and_says_the_commands(page):
    policy = sim2sim.load(page.folder / "policy.onnx")
    assert "velocity_commands" in policy.terms
    said = deploy.metadata(page.policy, robots.load(policy.robot), page.origin._replace(commands=RANGES))
    assert said["command_ranges"] == "0.0;1.2,0.0;0.0,-0.8;0.8"


@pytest.mark.parametrize("name", ["unitree_g1", "unitree_g1_29dof", "strider"])
def test_the_pages_model_is_that_of_training(tmp_path, name):
    """Number for number, but for what only the eye sees; its joints are as dry as the run's, not as the file's."""
    robot, physics = robots.load(name), preset("laptop", **{"physics.frictionloss": 0.07}).physics
    xml = web.model_xml(robot, physics)
    trained, made = native.model(robot, physics), mujoco.MjModel.from_xml_string(xml)
    for kind in ("body_", "jnt_", "dof_", "actuator_"):
        for field in (field for field in dir(trained) if field.startswith(kind)):
            # Where shapes stand in tables, and how large a body is, by which MuJoCo tells whether it may sleep.
            if field not in ("body_geomnum", "body_geomadr", "body_bvhadr", "body_bvhnum", "dof_length"):
                np.testing.assert_array_equal(getattr(made, field), getattr(trained, field), err_msg=field)
    for field in ("timestep", "iterations", "ls_iterations", "disableflags", "solver", "integrator", "cone"):
        assert getattr(made.opt, field) == getattr(trained.opt, field), field
    assert made.stat.meaninertia == trained.stat.meaninertia  # by which the solver knows when to stop
    colliding = [model.geom_contype + model.geom_conaffinity > 0 for model in (made, trained)]
    for field in ("geom_size", "geom_pos", "geom_quat", "geom_friction", "geom_solref", "geom_margin"):
        one, other = (getattr(model, field)[which] for model, which in zip((made, trained), colliding, strict=True))
        np.testing.assert_array_equal(one, other, err_msg=field)
    assert made.ngeom == robot.model.ngeom > trained.ngeom
    assert xml.startswith(robot.path.read_text()[:40])


# --- what is refused -------------------------------------------------------------------------------------------------


def test_a_folder_with_something_in_it_is_refused(page, robot):
    with pytest.raises(UserError, match="page is not an empty folder: expected a new one for the page"):
        deploy.write_page(page.folder, page.policy, robot, page.origin)
    with pytest.raises(UserError, match="index.html is not an empty folder"):
        deploy.write_page(page.folder / "index.html", page.policy, robot, page.origin)


def test_a_command_that_the_page_cannot_make_is_refused(tmp_path, robot, walk):
    with pytest.raises(UserError, match="observes 'clip_phase', which the page cannot make: expected a run without it"):
        written(tmp_path / "page", robot, walk, **{"command.kind": "phase"})
    assert not (tmp_path / "page").exists()


def test_a_robot_of_several_files_is_refused(tmp_path, robot, walk):
    folder = tmp_path / "mine"
    shutil.copytree(resources.folder("robots") / robot.name, folder)
    text = (folder / "robot.xml").read_text()
    (folder / "robot.xml").write_text(text.replace("<asset>", '<asset><mesh name="hull" file="hull.obj"/>'))
    (folder / "hull.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n")
    with pytest.raises(UserError, match="robot.xml needs the file hull.obj: expected a model of one file for a page"):
        written(tmp_path / "page", robots.load(str(folder)), walk)
    assert not (tmp_path / "page").exists()


# --- the programs of others ------------------------------------------------------------------------------------------


def archive(path, files):
    """An npm package's archive."""
    with tarfile.open(path, "w:gz") as made:
        for name, content in files.items():
            entry = tarfile.TarInfo(f"package/{name}")
            entry.size = len(content)
            made.addfile(entry, io.BytesIO(content))
    return path


@pytest.fixture
def stand_ins(tmp_path, monkeypatch):
    """Packages of our own that `npm pack` would bring, in place of the real ones."""
    made = {}
    for short, package in packages.PACKAGES.items():
        path = archive(tmp_path / f"{short}.tgz", {name: short.encode() for name in package.files.values()})
        digest = base64.b64encode(hashlib.sha512(path.read_bytes()).digest()).decode()
        made[short] = package._replace(sha512=digest, version=path.name)
    monkeypatch.setattr(packages, "PACKAGES", made)
    monkeypatch.setattr(packages, "fetch", lambda package, folder: tmp_path / package.version)
    return made


def test_what_a_page_takes_of_packages_comes_with_licenses(stand_ins):
    found = packages.collect()
    assert found["lib/three/OrbitControls.js"] == b"three"
    assert b"Apache License" in found["lib/mujoco/LICENSE"] and b"MIT License" in found["lib/onnxruntime-web/LICENSE"]
    assert b"- three three.tgz, MIT: lib/three\n" in found["lib/README.md"]


def test_another_archive_than_the_expected_one_is_refused(stand_ins, tmp_path):
    archive(tmp_path / "three.tgz", {"LICENSE": b"other"})
    with pytest.raises(UserError, match=r"three three.tgz has the SHA-512 \S{12}\.\.\.: expected"):
        packages.collect()


def test_without_npm_one_sentence_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setattr(shutil, "which", lambda name, path: None)
    with pytest.raises(UserError, match=r"--web needs npm, .*: install the extra fmpjax\[web\], or Node.js"):
        packages.fetch(packages.PACKAGES["three"], tmp_path)


def test_where_npm_fails_its_words_are_told(monkeypatch, tmp_path):
    npm = tmp_path / "npm"
    npm.write_text("#!/bin/sh\necho 'npm error code ENOTFOUND' >&2\nexit 1\n")
    npm.chmod(0o755)
    monkeypatch.setattr(shutil, "which", lambda name, path: str(npm))
    with pytest.raises(UserError, match=r"npm cannot get three@\S+ \(npm error code ENOTFOUND\): expected"):
        packages.fetch(packages.PACKAGES["three"], tmp_path)


# --- the command -----------------------------------------------------------------------------------------------------


def opened(folder, **changes):
    """A run that has not begun."""
    folder.mkdir()
    (folder / "config.json").write_text(config.to_json(preset("smoke", **changes)))
    return runs.Run.open(folder)


def test_the_folder_that_is_written_is_named_or_in_the_run(monkeypatch, tmp_path, capsys):
    run = opened(tmp_path / "run", **{"command.kind": "velocity", "env.axes": "heading"})
    asked = []
    monkeypatch.setattr(runs, "export", lambda run, out, onnx, best: asked.append((out, onnx)) or [])
    monkeypatch.setattr(runs, "web", lambda run, folder, best: asked.append(folder))
    for words, expected in (
        (["--onnx"], [(run.folder / "export", True)]),
        ([], [(run.folder / "export", False)]),
        ([str(tmp_path / "out")], [(tmp_path / "out", False)]),
        (["--web", str(tmp_path / "page")], [tmp_path / "page"]),
        (["--web", str(tmp_path / "page"), "--onnx"], [(run.folder / "export", True), tmp_path / "page"]),
    ):
        asked.clear()
        cli.main(["export", str(run.folder), *words])
        assert asked == expected
    assert "a page: see it with `python -m http.server --directory" in capsys.readouterr().out


def test_a_page_of_a_run_without_a_policy_is_refused(tmp_path):
    run = opened(tmp_path / "run")
    with pytest.raises(UserError, match="run has no checkpoint: --web needs one"):
        runs.web(run, tmp_path / "page")
    assert not (tmp_path / "page").exists()


# --- the robot in the page -------------------------------------------------------------------------------------------


OBSERVED = {
    "compact": {},
    "full": {"env.axes": "world"},
    "deployable": {"env.observation_history": 3},
}


@pytest.fixture(scope="module", params=OBSERVED)
def real(request, tmp_path_factory, robot, walk):
    """A page with the real programs of others, and the states of its policy in sim2sim, ``[STEPS, 13 + 2 J]``."""
    folder = tmp_path_factory.mktemp("web") / "page"
    changes = {"env.observation": request.param} | OBSERVED[request.param]
    try:
        made = written(folder, robot, walk, **changes)
    except UserError as error:
        pytest.skip(str(error))
    made.folder = folder
    simulation = sim2sim.Simulation(sim2sim.load(folder / "policy.onnx"), folder / "model.xml")
    assert simulation.differences == []
    simulation.command = np.array(TOLD)
    made.states = []
    for _ in range(STEPS):
        simulation.step()
        made.states.append([*simulation.qpos, *simulation.qvel])
    return made


NODE = """
import fs from "node:fs";
import loadMujoco from "./lib/mujoco/mujoco.js";
import { load } from "./policy.js";
import { Simulation } from "./simulation.js";

const policy = await load(fs.readFileSync("policy.onnx"), fs.readFileSync("lib/onnxruntime-web/ort.wasm"));
const sim = new Simulation(await loadMujoco(), fs.readFileSync("model.xml", "utf8"), policy);
sim.command = TOLD;
const states = [];
for (let i = 0; i < STEPS; i++) {
  await sim.step();
  states.push([...sim.qpos, ...sim.qvel]);
}
fs.writeFileSync("states.json", JSON.stringify(states));
"""


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("node"), reason="no Node.js here")
def test_the_first_steps_are_those_of_sim2sim(real):
    """The page's own code, MuJoCo and ONNX Runtime in WebAssembly, by Node.js."""
    (real.folder / "package.json").write_text('{"type": "module"}')
    (real.folder / "test.js").write_text(NODE.replace("TOLD", json.dumps(TOLD)).replace("STEPS", str(STEPS)))
    done = subprocess.run(["node", "test.js"], cwd=real.folder, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    states = np.array(json.loads((real.folder / "states.json").read_text()))
    np.testing.assert_allclose(states, real.states, atol=CLOSE)
    assert np.ptp(states, axis=0).max() > 0.1


@contextlib.contextmanager
def served(folder):
    """The address of a file server of a folder."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *arguments):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
def test_the_page_runs_in_a_browser(real):
    """It loads from a plain file server alone, obeys its sliders and buttons, and steps as sim2sim does."""
    api = pytest.importorskip("playwright.sync_api")
    with served(real.folder) as address, api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--enable-unsafe-swiftshader"])
        tab = browser.new_page(viewport={"width": 640, "height": 480})
        tab.set_default_timeout(300_000)
        asked, said = [], []
        tab.on("request", lambda request: asked.append(request.url))
        tab.on("console", lambda message: said.append(message.text))
        tab.on("pageerror", lambda error: said.append(str(error)))
        tab.goto(address)
        tab.wait_for_function("globalThis.page !== undefined")
        tab.click("#pause")
        states = np.array(
            tab.evaluate(
                """async ([told, steps]) => {
                  const { sim } = page;
                  while (page.stepping) await new Promise((go) => setTimeout(go, 10));
                  sim.reset();
                  sim.command = told;
                  const states = [];
                  for (let i = 0; i < steps; i++) {
                    await sim.step();
                    states.push([...sim.qpos, ...sim.qvel]);
                  }
                  return states;
                }""",
                [TOLD, STEPS],
            )
        )
        np.testing.assert_allclose(states, real.states, atol=CLOSE)
        tab.fill("#command-forward", "0.7")
        tab.click("[data-push='0,1']")
        assert tab.evaluate("page.sim.command[0]") == pytest.approx(0.7)
        assert np.linalg.norm(tab.evaluate("page.sim.force")) == pytest.approx(80.0)
        assert not tab.is_visible("#command-left") and tab.is_visible("#command-turn")
        tab.click("#reset")
        tab.wait_for_function("page.sim.time === 0")
        tab.click("#pause")
        tab.wait_for_function("page.sim.time > 0.1 || page.falls > 0")
        assert all(url.startswith((address, "data:")) for url in asked)
        assert [line for line in said if "GPU" not in line and "GL" not in line] == []
        browser.close()

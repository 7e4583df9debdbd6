"""A static page on which a policy runs in the visitor's browser.

The page reads the same ``policy.onnx`` as every other program, and builds the observation from the names in it. Its
``model.xml`` is the robot's own file with the time step and the solver settings of the training.
"""

import shutil
import tempfile
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from fmpjax import features, sim2sim
from fmpjax.config import PhysicsConfig
from fmpjax.deploy import packages
from fmpjax.deploy.files import write
from fmpjax.deploy.origin import Origin
from fmpjax.errors import UserError
from fmpjax.policy import Policy
from fmpjax.robots import Robot

PAGE = Path(__file__).parent / "page"


def write_page(folder: Path, policy: Policy, robot: Robot, origin: Origin) -> list[Path]:
    """Write a page, its policy, the robot's model and the programs of others into a new ``folder``; the paths written.

    Raises:
      UserError: ``folder`` is not empty, or the page cannot make the policy's observation or the robot's model, or a
        program of others cannot be had.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UserError(f"{folder} is not an empty folder: expected a new one for the page")
    unknown = [name for name in features.observation_terms(robot, policy.observation) if name not in sim2sim.TERMS]
    if unknown:
        raise UserError(f"the policy observes {unknown[0]!r}, which the page cannot make: expected a run without it")
    xml = model_xml(robot, origin.config.physics)
    with tempfile.TemporaryDirectory() as made:
        page = Path(made) / "page"  # of which, unlike the temporary folder, everybody may read
        page.mkdir()
        write(page, policy, robot, origin, unitree=False)
        sim2sim.load(page / "policy.onnx")  # which refuses what no program could run
        for name, content in packages.collect().items():
            path = page / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        (page / "model.xml").write_text(xml)
        shutil.copytree(PAGE, page, dirs_exist_ok=True)
        shutil.copytree(page, folder, dirs_exist_ok=True)
    return sorted(path for path in folder.rglob("*") if path.is_file())


def model_xml(robot: Robot, physics: PhysicsConfig) -> str:
    """The robot's file, looks included, with the solver settings of a run, as `Robot.physics_model` has them.

    Raises:
      UserError: the file needs other files, which a page cannot read.
    """
    text = robot.path.read_text()
    root = ElementTree.fromstring(text)
    for element in root.iter():
        if "file" in element.attrib:
            raise UserError(
                f"{robot.path} needs the file {element.attrib['file']}: expected a model of one file for a page"
            )
    option = root.find("option")
    if option is None:
        option = ElementTree.SubElement(root, "option")
    for name in ("timestep", "iterations", "ls_iterations"):
        option.set(name, repr(getattr(physics, name)))
    flag = option.find("flag")
    if flag is None:
        flag = ElementTree.SubElement(option, "flag")
    flag.set("autoreset", "disable")  # a state that blows up is a fall
    for world in root.findall("worldbody"):
        for joint in world.iter("joint"):
            if joint.get("type") != "free":
                joint.set("frictionloss", repr(float(physics.frictionloss)))
    # ElementTree drops what is before the root, where a file says whose it is.
    return text[: text.index("<mujoco")] + ElementTree.tostring(root, encoding="unicode") + "\n"

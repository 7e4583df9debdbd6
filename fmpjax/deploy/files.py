"""The files of an exported policy."""

import importlib.util
import shutil
from pathlib import Path

from fmpjax import features
from fmpjax.deploy.model_card import card
from fmpjax.deploy.network import check_widths, graph
from fmpjax.deploy.origin import Origin
from fmpjax.deploy.properties import metadata
from fmpjax.deploy.unitree import no_stock, stock
from fmpjax.errors import UserError
from fmpjax.policy import Policy
from fmpjax.robots import Robot


def check_installed(option: str = "--onnx") -> None:
    """Refuse where the package onnx is missing, which ``option`` needs.

    Raises:
      UserError: it is.
    """
    if importlib.util.find_spec("onnx") is None:
        raise UserError(f"{option} needs the package onnx, which is not installed: install the extra fmpjax[deploy]")


def write(folder: Path, policy: Policy, robot: Robot, origin: Origin, *, unitree: bool = True) -> list[Path]:
    """Write ``policy.onnx`` and ``MODEL_CARD.md`` into ``folder``; the paths written.

    Where Unitree's stock program can run the policy, ``params/deploy.yaml`` and ``exported/policy.onnx``, too, where
    that program looks for them, unless ``unitree`` is false.

    Raises:
      UserError: the widths of observation, layers and joints do not fit together, or a number is not finite.
    """
    import onnx

    terms = features.observation_terms(robot, policy.observation)
    check_widths(policy, terms)
    model = graph(policy)
    onnx.helper.set_model_props(model, metadata(policy, robot, origin))
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, folder / "policy.onnx")
    (folder / "MODEL_CARD.md").write_text(card(policy, robot, origin))
    paths = [folder / "policy.onnx", folder / "MODEL_CARD.md"]
    if unitree and no_stock(robot, policy.observation) is None:
        for path in (exported := folder / "exported" / "policy.onnx", settings := folder / "params" / "deploy.yaml"):
            path.parent.mkdir(exist_ok=True)
        settings.write_text(stock(policy, robot, origin))
        shutil.copy2(folder / "policy.onnx", exported)
        paths += [exported, settings]
    return paths

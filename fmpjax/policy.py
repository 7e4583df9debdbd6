"""A trained policy without the training stack: one small file, and NumPy to run it."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from zipfile import BadZipFile

import numpy as np

from fmpjax.errors import UserError

if TYPE_CHECKING:
    from fmpjax.ppo import PPOState
    from fmpjax.trainer import Trainer

LIVE = "live.npz"  # in a run's folder, its policy while it trains with --live
LAYERED = ("kernels", "biases", "estimator_kernels", "estimator_biases")  # fields with an array for each layer
_EXPECTED = "expected policy.npz as `fmpjax export` writes it"
_ACTIVATIONS = {
    "relu": lambda x: np.maximum(x, 0.0),
    "elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0.0))),
    "swish": lambda x: x / (1.0 + np.exp(-x)),
    "tanh": np.tanh,
}


class Policy(NamedTuple):
    """The mean action of a trained policy, as joint targets."""

    joint_names: tuple[str, ...]  # J, the order of targets
    observation: str  # such as "compact", as `features.observation_form` names it
    rate: float  # Hz, of control
    activation: str
    kernels: tuple[np.ndarray, ...]  # of the layers, [in, out]
    biases: tuple[np.ndarray, ...]  # [out]
    mean: np.ndarray  # [O], of the observations in training
    deviation: np.ndarray  # [O]
    clip: float  # of normalized observations
    center: np.ndarray  # [J] rad, the targets of action zero
    scale: np.ndarray  # [J] rad, a unit of action
    low: np.ndarray  # [J] rad, of the targets
    high: np.ndarray  # [J] rad
    # Of a network that estimates what the robot does not sense; the policy's first layer sees its output, too.
    estimator_kernels: tuple[np.ndarray, ...] = ()
    estimator_biases: tuple[np.ndarray, ...] = ()
    inputs: np.ndarray = np.zeros(0, int)  # of the observation, what the first layer then sees; empty: all

    def __repr__(self) -> str:
        return (
            f"Policy({len(self.mean)} {self.observation} observations -> {len(self.joint_names)} joint targets, "
            f"layers {[len(bias) for bias in self.biases]}, {self.activation}, {self.rate:g} Hz)"
        )

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Joint targets ``[..., J]`` (rad), for the servos to hold, from observations ``[..., O]``.

        Raises:
          UserError: the observations have another length.
        """
        length = np.shape(observation)[-1:]
        if length != self.mean.shape:
            raise UserError(
                f"the observation has {length[0] if length else 'no'} numbers: expected {len(self.mean)}, "
                f"for the observation {self.observation!r} of this policy"
            )
        # In double precision: a robot gets the same targets alone and in a batch, whatever library multiplies.
        x = np.clip((np.float64(observation) - self.mean) / self.deviation, -self.clip, self.clip)
        if self.estimator_kernels:
            estimate = self._network(x, self.estimator_kernels, self.estimator_biases)
            x = np.concatenate([x[..., self.inputs] if self.inputs.size else x, estimate], axis=-1)
        action = self._network(x, self.kernels, self.biases)
        return np.clip(self.center + self.scale * action, self.low, self.high)

    def _network(self, x: np.ndarray, kernels: tuple[np.ndarray, ...], biases: tuple[np.ndarray, ...]) -> np.ndarray:
        for kernel, bias in zip(kernels[:-1], biases[:-1], strict=True):
            x = _ACTIVATIONS[self.activation](x @ kernel + bias)
        return x @ kernels[-1] + biases[-1]


def of(trainer: "Trainer", state: "PPOState") -> Policy:
    """The policy of a training state."""
    from fmpjax.acting import of_actor  # brings JAX, which a policy does without

    config, robot, actions = trainer.config, trainer.robot, trainer.env.actions
    kernels, biases = zip(*trainer.ppo.layers(state.actor), strict=True)
    estimator = trainer.ppo.estimator_layers(state.actor)
    return Policy(
        joint_names=tuple(robot.joint_names),
        observation=trainer.env.form,
        rate=float(config.control_rate),
        activation=config.ppo.activation,
        kernels=kernels,
        biases=biases,
        estimator_kernels=tuple(kernel for kernel, _ in estimator),
        estimator_biases=tuple(bias for _, bias in estimator),
        inputs=np.array(trainer.ppo.inputs, int),
        mean=np.asarray(of_actor(state.normalizer.mean)),
        deviation=np.asarray(of_actor(state.normalizer.std)),
        clip=float(config.ppo.normalizer_clip),
        **{name: np.asarray(value, np.float32) for name, value in actions._asdict().items()},
    )


def save(path: Path, policy: Policy, metadata: Mapping[str, str] | None = None) -> Path:
    """Write a policy as ``.npz``, a layer's arrays each on their own, whole or not at all; the path written.

    ``metadata`` is what `fmpjax.deploy.metadata` says of it, by which `fmpjax play` simulates its robot.
    """
    arrays = policy._asdict()
    for name in LAYERED:
        arrays |= {f"{name}.{i}": array for i, array in enumerate(arrays.pop(name))}
    if metadata is not None:
        arrays["metadata"] = json.dumps(dict(metadata))
    partial = path.with_name(path.name + ".partial")
    with partial.open("wb") as file:
        np.savez(file, **arrays)
    os.replace(partial, path)
    return path


def metadata(path: str | Path) -> dict[str, str]:
    """What `save` was told of the policy.

    Raises:
      UserError: the file is missing or is no policy, or `save` was told nothing.
    """
    try:
        with np.load(path) as file:
            said = json.loads(file["metadata"].item()) if "metadata" in file else None
    except (OSError, ValueError, TypeError, EOFError, BadZipFile) as error:
        raise UserError(f"{path} is not a policy ({error}): {_EXPECTED}") from None
    if not (isinstance(said, dict) and all(isinstance(text, str) for text in said.values())):
        raise UserError(f"{path} does not say what its robot is: {_EXPECTED}")
    return said


def load(path: str | Path) -> Policy:
    """Read a policy from ``policy.npz``, which ``fmpjax export`` writes.

    Raises:
      UserError: the file is missing or is no policy.
    """
    try:
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files if name != "metadata"}
        for name in LAYERED:
            layers = range(sum(key.startswith(f"{name}.") for key in arrays))
            arrays[name] = tuple(arrays.pop(f"{name}.{i}") for i in layers)
        arrays |= {name: arrays[name].item() for name in ("observation", "rate", "activation", "clip")}
        arrays["joint_names"] = tuple(map(str, arrays["joint_names"]))
        return Policy(**arrays)
    except (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile) as error:
        raise UserError(f"{path} is not a policy ({error}): {_EXPECTED}") from None

"""What the policy observes and what the prior scores (section IV-A of the paper).

Sizes follow from the robot. For the G1 the full forms are 237 numbers for the actor and windows of ten 239-number
frames for the prior. Most of a frame's joint rotations repeat each other: a hinge about y turns six coordinates of
which two are constant and four are its sine and cosine, twice each. The program therefore keeps *compact frames* (117
numbers for 29 hinges) and gives the doubled coordinates the weight sqrt(2), which leaves every distance between windows
what it was, and so what SGD does to a first layer. Adam, which moves every weight alike, moves a doubled coordinate's
share of a sum 1/sqrt(2) as fast as it would move the two.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fmpjax import kinematics, rotations
from fmpjax.config import Config, FeatureConfig
from fmpjax.errors import UserError
from fmpjax.frames import FORWARD, PLANAR, FrameLayout, headed
from fmpjax.motion.library import parse
from fmpjax.robots import Robot

Floats = jax.Array | np.ndarray  # JAX takes both


class _Parts(NamedTuple):
    """The physical quantities that every observation is made of, float32 or float64 as the state."""

    root: jax.Array  # [..., 3] m
    rotation: jax.Array  # [..., 6]
    velocity: jax.Array  # [..., 3] m/s, world
    angular_velocity: jax.Array  # [..., 3] rad/s, world
    key_points: jax.Array  # [..., 3 K] m, relative to the root
    joints: jax.Array  # [..., J] rad
    joint_velocity: jax.Array  # [..., J] rad/s


def _parts(robot: Robot, qpos, qvel, poses: kinematics.BodyPoses | None = None) -> _Parts:
    qpos, qvel = jnp.asarray(qpos), jnp.asarray(qvel)
    if qpos.shape[-1] != 7 + robot.joint_count or qvel.shape[-1] != 6 + robot.joint_count:
        raise UserError(
            f"state of {qpos.shape[-1]} positions and {qvel.shape[-1]} velocities: robot {robot.name} expects "
            f"{7 + robot.joint_count} and {6 + robot.joint_count}"
        )
    poses = kinematics.body_poses(robot, qpos) if poses is None else poses
    offsets = kinematics.key_points(robot, poses) - qpos[..., None, :3]
    return _Parts(
        root=qpos[..., :3],
        rotation=rotations.to_6d(qpos[..., 3:7]),
        velocity=qvel[..., :3],
        # MuJoCo gives the root's angular velocity in the body's axes.
        angular_velocity=rotations.rotate(qpos[..., 3:7], qvel[..., 3:6]),
        key_points=offsets.reshape(*offsets.shape[:-2], -1),
        joints=qpos[..., 7:],
        joint_velocity=qvel[..., 6:],
    )


def _rotation_terms(robot: Robot) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """6D rotation of each hinge as ``cosine * C + sine * S + K``, each ``[J, 6]`` (Rodrigues)."""
    axis = robot.joint_axis
    cosine, sine, constant = [], [], []
    for column in (0, 2):
        unit = np.eye(3)[column]
        along = axis * axis[:, [column]]
        cosine.append(unit - along)
        sine.append(np.cross(axis, unit))
        constant.append(along)
    return np.concatenate(cosine, axis=-1), np.concatenate(sine, axis=-1), np.concatenate(constant, axis=-1)


def _joint_rotations(robot: Robot, joints: jax.Array) -> jax.Array:
    """6D rotations in body order, ``[..., 6 J]``, with the identity row of a jointless body ``[..., 6 (J + 1)]``."""
    cosine, sine, constant = (jnp.asarray(t, joints.dtype) for t in _rotation_terms(robot))
    angle = joints[..., None]
    rows = jnp.cos(angle) * cosine + jnp.sin(angle) * sine + constant
    if (cut := robot.jointless_row) is not None:
        identity = jnp.broadcast_to(jnp.array([1, 0, 0, 0, 0, 1], rows.dtype), (*rows.shape[:-2], 1, 6))
        rows = jnp.concatenate([rows[..., :cut, :], identity, rows[..., cut:, :]], axis=-2)
    return rows.reshape(*rows.shape[:-2], -1)


@partial(jax.jit, static_argnames=("robot",), inline=True)
def actor_observation(
    robot: Robot, qpos: Float[Floats, "*batch q"], qvel: Float[Floats, "*batch v"]
) -> Float[jax.Array, "*batch O"]:
    """The policy's observation, ``[..., 237]`` for the G1.

    Root height (m), root rotation 6D, root velocity (m/s) and angular velocity (rad/s) in world axes, joint rotations
    6D, joint velocities (rad/s), key points less the root (m).

    Args:
      qpos: ``[..., 7 + J]`` root xyz, quaternion wxyz, joints.
      qvel: ``[..., 6 + J]`` root velocity in the world, root angular velocity in the body, joint velocities.
    """
    return _observation(robot, _parts(robot, qpos, qvel), "full")


def observation_form(config: Config, *, history: bool = True) -> str:
    """What the policy of a configuration observes, in words such as "compact heading velocity" or "deployable".

    With ``history`` the form of a policy that sees earlier steps, too, ends with a word such as "history-5".
    """
    steps = config.env.observation_history if history else 1
    axes = "world" if config.env.observation == "deployable" else config.env.axes
    told = config.command.kind
    if told == "motion":
        told += f"-{len(parse(config.motion))}"
    words = [config.env.observation, axes, told, f"history-{steps}"]
    return " ".join(word for word in words if word not in ("world", "none", "history-1"))


def true_form(config: Config) -> str:
    """What `observe` gives: what the policy of a configuration observes, or the critic of one that is deployable."""
    content = "compact" if config.env.observation == "deployable" else config.env.observation
    return content if config.env.axes == "world" else f"{content} {config.env.axes}"


def estimated_columns(robot: Robot, config: Config) -> list[int]:
    """Where a critic observes what no sensor of a robot measures: its root's height and linear velocity."""
    columns, start = [], 0
    for name, width in observation_terms(robot, true_form(config)).items():
        if name == "root_height" or name.endswith("_linear_velocity"):
            columns += range(start, start + width)
        start += width
    return columns


def newest_columns(robot: Robot, form: str) -> list[int]:
    """Where an observation with a history holds its last step; nothing for one without a history."""
    steps, columns, start = observation_history(form), [], 0
    for width in observation_terms(robot, form).values():
        columns += range(start + width - width // steps, start + width)
        start += width
    return columns if steps > 1 else []


def _command_terms(robot: Robot, form: str) -> dict[str, int]:
    """Names and widths of what a policy observes of its command."""
    content, *more = form.split()
    for kind, _, motions in (word.partition("-") for word in more):
        if kind == "velocity":
            return {"velocity_commands": 3} | ({} if content == "deployable" else {"velocity_errors": 3})
        if kind == "phase":
            return {"clip_phase": 5 + robot.joint_count}
        if kind == "motion":
            distances = {} if content == "deployable" else {"motion_distances": int(motions)}
            return {"motion_command": int(motions)} | distances
    return {}


def observation_history(form: str) -> int:
    """Control steps that an observation of a form, as `observation_form` gives it, is of."""
    return next((int(word.removeprefix("history-")) for word in form.split() if word.startswith("history-")), 1)


def observation_terms(robot: Robot, form: str) -> dict[str, int]:
    """Names and widths of the parts of the policy's observation, in their order.

    A part with a history holds its steps one after another, the oldest first.

    Args:
      robot: that is observed.
      form: as `observation_form` gives it.
    """
    content, *more = form.split()
    joints, axes = robot.joint_count, "heading" if "heading" in more else "root"
    told = _command_terms(robot, form)
    if content == "deployable":
        terms = {"base_ang_vel": 3, "projected_gravity": 3} | told
        terms |= {"joint_pos_rel": joints, "joint_vel_rel": joints, "last_action": joints}
        return {name: observation_history(form) * width for name, width in terms.items()}
    angles = {"joint_rotation_6d": 6 * _rotations(robot)} if content == "full" else {"joint_position": joints}
    root = {"root_height": 1, f"{axes}_rotation_6d": 6, f"{axes}_linear_velocity": 3, f"{axes}_angular_velocity": 3}
    points = {"heading_key_points" if "heading" in more else "key_points": 3 * len(robot.key_body)}
    return root | angles | {"joint_velocity": joints} | points | told


def observation(
    robot: Robot, qpos: Float[Floats, "*batch q"], qvel: Float[Floats, "*batch v"], form: str
) -> Float[jax.Array, "*batch O"]:
    """The observation ``[..., O]`` of states, in a form that is not deployable, without the command."""
    return _observation(robot, _parts(robot, qpos, qvel), form)


def _observation(robot: Robot, p: _Parts, form: str) -> jax.Array:
    own = _turned(p)
    parts = {
        "root_height": p.root[..., 2:],
        "root_rotation_6d": p.rotation,
        "root_linear_velocity": p.velocity,
        "root_angular_velocity": p.angular_velocity,
        "heading_rotation_6d": own.rotation,
        "heading_linear_velocity": own.velocity,
        "heading_angular_velocity": own.angular_velocity,
        "joint_position": p.joints,
        "joint_velocity": p.joint_velocity,
        "key_points": p.key_points,
        "heading_key_points": own.key_points,
    }
    if form.startswith("full"):
        parts["joint_rotation_6d"] = _joint_rotations(robot, p.joints)
    # Of the command the environment has to add its own.
    return jnp.concatenate([parts[name] for name in observation_terms(robot, form) if name in parts], axis=-1)


@partial(jax.jit, static_argnames=("robot",), inline=True)
def prior_window(
    robot: Robot, qpos: Float[Floats, "*batch H q"], qvel: Float[Floats, "*batch H v"]
) -> Float[jax.Array, "*batch D"]:
    """The prior's window before normalization, ``[..., H * 239]`` for the G1, oldest frame first.

    A frame is root position (m; x and y relative to the newest frame, z absolute), root rotation 6D, joint rotations
    6D, key points less that frame's root (m), root velocity (m/s), root angular velocity (rad/s), joint velocities
    (rad/s).

    Args:
      qpos: ``[..., H, 7 + J]`` states, oldest first.
      qvel: ``[..., H, 6 + J]``.
    """
    p = _parts(robot, qpos, qvel)
    root = p.root.at[..., :2].add(-p.root[..., -1:, :2])
    frames = jnp.concatenate(
        [
            root,
            p.rotation,
            _joint_rotations(robot, p.joints),
            p.key_points,
            p.velocity,
            p.angular_velocity,
            p.joint_velocity,
        ],
        axis=-1,
    )
    return frames.reshape(*frames.shape[:-2], -1)


class Observed(NamedTuple):
    """What one forward-kinematics pass of a state gives."""

    actor: jax.Array  # [..., O] the policy's observation
    frame: jax.Array  # [..., F] compact frame with absolute root position
    fallen: jax.Array  # [...] bool


def _turned(p: _Parts) -> _Parts:
    """The same in axes of which x points where the root faces."""
    names = ("rotation", "velocity", "angular_velocity", "key_points")
    return p._replace(**{name: headed(p.rotation[..., :2], getattr(p, name)) for name in names})


@partial(jax.jit, static_argnames=("robot", "form"), inline=True)
def observe(robot: Robot, qpos: Float[Floats, "*batch q"], qvel: Float[Floats, "*batch v"], form: str) -> Observed:
    """The policy's observation, the compact frame and the fall test of states ``qpos``, ``qvel``.

    The observation is of the robot alone, in the ``form`` that `observation_form` names, without the command.
    """
    poses = kinematics.body_poses(robot, qpos)
    p = _parts(robot, qpos, qvel, poses)
    frame = FrameLayout.join(
        root=p.root,
        rotation=p.rotation,
        cosine=jnp.cos(p.joints),
        sine=jnp.sin(p.joints),
        key_points=p.key_points,
        velocity=p.velocity,
        angular_velocity=p.angular_velocity,
        joint_velocity=p.joint_velocity,
    )
    return Observed(_observation(robot, p, form), frame, kinematics.fallen(robot, poses))


def _rotations(robot: Robot) -> int:
    """Joint rotations in a full frame, of which a jointless body has one."""
    return robot.joint_count + (robot.jointless_row is not None)


def frame_size(robot: Robot) -> int:
    """Numbers in a full frame of the prior, 239 for the G1: 6D rotations in place of cosines and sines."""
    return FrameLayout.of(robot).size - 2 * robot.joint_count + 6 * _rotations(robot)


def compact_weights(robot: Robot) -> Float[np.ndarray, " F"]:
    """How often a compact coordinate occurs in the full frame, as a distance weight (square root), ``[F]``."""
    cosine, sine, _ = _rotation_terms(robot)
    if not np.isin(np.abs(robot.joint_axis), (0, 1)).all():
        raise UserError(f"robot {robot.name} has a hinge off its body's axes: compact frames need axes along x, y or z")
    layout = FrameLayout.of(robot)
    weights = np.ones(layout.size)
    weights[layout.cosine], weights[layout.sine] = np.linalg.norm(cosine, axis=-1), np.linalg.norm(sine, axis=-1)
    return weights


def turned_windows(windows: Float[jax.Array, "*batch H F"], layout: FrameLayout) -> Float[jax.Array, "*batch H F"]:
    """Relative windows ``[..., H, F]`` in axes of which x points where the newest frame's root does."""
    forward = windows[..., -1:, FORWARD]
    parts = {name: windows[..., part] for name, part in layout._asdict().items()}
    for name in ("root", "rotation", "key_points", "velocity", "angular_velocity"):
        parts[name] = headed(forward, parts[name])
    return FrameLayout.join(**parts)


def in_own_heading(robot: Robot, frames: Float[jax.Array, "*batch F"]) -> Float[jax.Array, "*batch F"]:
    """Compact frames ``[..., F]`` in axes of which x points where each frame's root does."""
    return turned_windows(frames[..., None, :], FrameLayout.of(robot))[..., 0, :]


def relative_windows(frames: Float[jax.Array, "*batch H F"]) -> Float[jax.Array, "*batch H F"]:
    """Windows ``[..., H, F]`` of compact frames with x and y made relative to the newest frame."""
    planar, rest = frames[..., PLANAR], frames[..., PLANAR.stop :]
    return jnp.concatenate([planar - planar[..., -1:, :], rest], axis=-1)


class FeatureMap(NamedTuple):
    """The fixed map f from windows to the features that transport compares.

    Standardize with the demonstration's mean and deviation, clip, weigh, divide by sqrt(d), where d counts the full
    frame's coordinates: distances are those of the full features, 2,390 for the G1.
    """

    mean: jax.Array  # [H, F]
    deviation: jax.Array  # [H, F]
    weight: jax.Array  # [F], multiplicity over sqrt(d)
    clip: jax.Array  # scalar
    dimension: jax.Array  # scalar, d
    turned: FrameLayout | None = None  # set where windows are turned to their own heading

    def __call__(self, frames: Float[jax.Array, "*batch H F"]) -> Float[jax.Array, "*batch D"]:
        """Features ``[..., H * F]`` of windows of compact frames ``[..., H, F]``, absolute or relative."""
        z = (_placed(frames, self.turned) - self.mean) / self.deviation
        x = jnp.clip(z, -self.clip, self.clip) * self.weight
        return x.reshape(*x.shape[:-2], -1)

    def placed(self, frames: Float[jax.Array, "*batch F"]) -> Float[jax.Array, "*batch F"]:
        """Single frames ``[..., F]`` as the newest of a window: x and y are 0, and vectors are in the map's axes."""
        return _placed(frames[..., None, :], self.turned)[..., 0, :]

    def unclipped(self) -> "FeatureMap":
        """The same map without the clip, for a prior that normalizes and clips windows itself."""
        return self._replace(clip=jnp.float32(jnp.inf))


def fit_feature_map(
    robot: Robot,
    windows: Float[jax.Array, "W H F"],
    config: FeatureConfig,
    share: Float[np.ndarray, " W"] | None = None,
) -> FeatureMap:
    """Feature map from the demonstrations' windows of compact frames ``[W, H, F]``, weighed by ``share [W]``."""
    dimension = config.history * frame_size(robot)
    layout = FrameLayout.of(robot)
    turned = layout if config.axes == "heading" else None
    relative = np.asarray(_placed(windows, turned), np.float64)
    mean = relative.mean(0) if share is None else np.average(relative, axis=0, weights=share)
    deviation = np.sqrt(np.average((relative - mean) ** 2, axis=0, weights=share))
    floor = np.full(layout.size, config.deviation_floor)
    floor[layout.angular_velocity] = floor[layout.joint_velocity] = config.angular_velocity_floor
    return FeatureMap(
        mean=jnp.asarray(mean, jnp.float32),
        deviation=jnp.asarray(np.maximum(deviation, floor), jnp.float32),
        weight=jnp.asarray(compact_weights(robot) / np.sqrt(dimension), jnp.float32),
        clip=jnp.float32(config.clip),
        dimension=jnp.float32(dimension),
        turned=turned,
    )


def _placed(frames: jax.Array, turned: FrameLayout | None) -> jax.Array:
    relative = relative_windows(frames)
    return relative if turned is None else turned_windows(relative, turned)

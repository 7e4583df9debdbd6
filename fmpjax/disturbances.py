"""What disturbs a robot: another body and floor than its model, pushes, late actions, and sensors that err.

All of it lives in the state of each environment, the sizes too, so that one program serves any of them. Between the
robot and its networks stand two functions: `Disturbances.act` makes joint targets from an action, and
`Disturbances.sense` an observation from a state.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fmpjax import features, kinematics, rotations
from fmpjax.actions import ActionMap
from fmpjax.config import Config, DisturbanceConfig
from fmpjax.errors import UserError
from fmpjax.physics import PhysicsState, Traits, traits
from fmpjax.robots import Robot

_NEVER = 1e8  # control steps to the next push where there is none
_PUSH, _WAIT, _DELAY, _NOISE = 6, 1, 1, 5  # random numbers of a step; of the noise two per joint come on top
_FLOORS = 2  # random numbers of uneven ground
_CLEAR = 0.005  # m, by which a foot is above a floor that it does not touch


class Sizes(NamedTuple):
    """How large the disturbances of N environments are."""

    delay: jax.Array  # [N, 2] physics steps, the shortest and the longest
    noise: jax.Array  # [N, 4] most of angular velocity rad/s, tilt rad, joint angle rad, joint velocity rad/s
    interval: jax.Array  # [N, 2] control steps between pushes
    speed: jax.Array  # [N, 2] m/s
    spin: jax.Array  # [N, 3] most of lift m/s, roll and pitch rad/s, turn rad/s
    step: Any = ()  # [N, 1] m, highest step of uneven ground; nothing on even ground


class Episode(NamedTuple):
    """What begins again with each episode."""

    fresh: jax.Array  # [N] bool, whether nothing was sensed yet
    delay: jax.Array  # [N] int32, physics steps by which actions come late
    wait: jax.Array  # [N] int32, control steps to the next push, that one included
    sent: jax.Array  # [N, D, J] earlier actions, newest last; zero before the first
    sensed: Any  # [N, H - 1, S] what the sensors said at earlier steps, oldest first; nothing without a history
    floors: Any = ()  # [N, 2] m, heights of the floor under the two feet; nothing on even ground
    ahead: Any = ()  # [N, 2] m, those of the next footsteps


class State(NamedTuple):
    """Disturbances of N environments."""

    body: Any  # Traits but for the floors, drawn once; nothing where no robot differs
    bias: jax.Array  # [N, J] rad, of the encoders, drawn once
    sizes: Sizes
    share: jax.Array  # [N] of the pushes' size, the same for all; it may grow in training
    episode: Episode


class Disturbances:
    """Pure functions of the disturbances that a configuration asks for, and of the sensors of a deployable policy.

    Args:
      config: of the run; it says what there may be. The sizes are in the state, and `init` may take them from another.
      robot: that is disturbed.
      actions: its joint targets.
      told: numbers of the command that the actor sees.

    Raises:
      UserError: the robot names no torso and its body is to differ, or it would have a torso of no mass.
    """

    def __init__(self, config: Config, robot: Robot, actions: ActionMap, told: int):
        self.config, self.robot, self.actions = config.disturbance, robot, actions
        self.substeps, self.rate = config.physics.substeps, config.control_rate
        self.frictionloss = config.physics.frictionloss
        self.history, self.form = config.env.observation_history, features.observation_form(config)
        self.deployable = config.env.observation == "deployable"
        self.uneven = bool(self.config.step_height)
        self.depth = max(1, -(-max(self.config.delay, default=0) // self.substeps))
        joints = robot.joint_count
        self.draws = _PUSH + _WAIT + _DELAY + (_NOISE + 2 * joints if self.config.noisy else 0)
        if self.config.bodies:
            _check_torso(robot, self.config)
        single = features.observation_form(config, history=False)
        self._widths = list(features.observation_terms(robot, single).values()) if self.deployable else []
        self.told = told

    def init(self, key: jax.Array, count: int, config: DisturbanceConfig | None = None) -> State:
        """Disturbances of ``count`` environments whose episodes begin; sizes are those of ``config``, or the run's."""
        config, joints = config or self.config, self.robot.joint_count
        body_key, bias_key, begin_key = jax.random.split(key, 3)
        bias = config.encoder_bias * jax.random.uniform(bias_key, (count, joints), minval=-1.0)
        sizes = _sizes(config, self.rate, count)
        if self.uneven:
            sizes = sizes._replace(step=jnp.full((count, 1), config.step_height, jnp.float32))
        share = jnp.full(count, config.push_start, jnp.float32)
        drawn = self.draw(begin_key, (count,))
        body = _body(config, self.frictionloss, body_key, count, joints) if self.config.bodies else ()
        return State(body, bias, sizes, share, self.begin(sizes, drawn))

    def draw(self, key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        """Random numbers of steps, ``[*shape, K]`` in [0, 1)."""
        drawn = jax.random.uniform(key, (*shape, self.draws))
        if not self.uneven:
            return drawn
        floors = jax.random.uniform(jax.random.fold_in(key, 1), (*shape, _FLOORS))
        return jnp.concatenate([drawn, floors], axis=-1)

    def begin(self, sizes: Sizes, drawn: jax.Array) -> Episode:
        """Episodes that begin, with random numbers ``drawn [N, K]``. A push comes at any time of its first interval."""
        count, joints = len(drawn), self.robot.joint_count
        wait = drawn[:, _PUSH + _WAIT - 1] * sizes.interval[:, 1]
        first, last = sizes.delay.T
        delay = jnp.floor(first + drawn[:, _PUSH + _WAIT] * (last - first + 1.0))
        return Episode(
            fresh=jnp.ones(count, bool),
            delay=jnp.minimum(delay, last).astype(jnp.int32),
            wait=1 + wait.astype(jnp.int32),
            sent=jnp.zeros((count, self.depth, joints)),
            sensed=jnp.zeros((count, self.history - 1, sum(self._widths))) if self.history > 1 else (),
            floors=jnp.zeros((count, _FLOORS)) if self.uneven else (),
            ahead=self._heights(sizes, drawn) if self.uneven else (),
        )

    def act(self, state: State, sim: PhysicsState, action: jax.Array, drawn: jax.Array) -> tuple[Any, State]:
        """What a control step of the physics takes, ``(state, targets[, traits])``, and the disturbances after it."""
        episode, sizes = state.episode, state.sizes
        if self.config.push_interval:
            first, last = sizes.interval.T
            wait = jnp.round(first + drawn[:, _PUSH] * (last - first)).astype(jnp.int32)
            sim = sim._replace(qvel=sim.qvel.at[:, :6].add(self.push(state, drawn)))
            episode = episode._replace(wait=jnp.where(episode.wait <= 1, wait, episode.wait - 1))
        sent = jnp.concatenate([episode.sent, self.actions.clipped(action)[:, None]], axis=1)
        episode = episode._replace(sent=sent[:, 1:])
        if self.config.delay:
            late = (jnp.arange(self.substeps) - episode.delay[:, None]) // self.substeps  # control steps, up to 0
            action = jnp.take_along_axis(sent, jnp.maximum(self.depth + late, 0)[..., None], axis=1)
        targets = self.actions(action)
        if self.config.encoder_bias:  # servos hold what the encoders say
            targets -= state.bias[:, None] if targets.ndim == 3 else state.bias
        if self.uneven:
            episode = self._stepped(episode, sizes, sim, drawn)
        state = state._replace(episode=episode)
        if not self.config.bodies:
            return (sim, targets), state
        floors = episode.floors if self.uneven else jnp.zeros((len(targets), _FLOORS))
        return (sim, targets, state.body._replace(floors=floors)), state

    def _heights(self, sizes: Sizes, drawn: jax.Array) -> jax.Array:
        """Heights of floors, ``[N, 2]`` m: up to half of the highest step above or below the level."""
        return sizes.step * (drawn[:, -_FLOORS:] - 0.5)

    def _stepped(self, episode: Episode, sizes: Sizes, sim: PhysicsState, drawn: jax.Array) -> Episode:
        """The episodes with the floors on which the feet will land.

        A foot in the air is above its next floor as soon as it is higher than both that and the one it left. If it is
        never lifted so high, it comes down where it was. While it touches, what comes next is drawn again and again.
        """
        soles = kinematics.sole_heights(self.robot, kinematics.body_poses(self.robot, sim.qpos))
        lowest = jnp.stack([soles[:, self.robot.sole_body == foot].min(-1) for foot in self.robot.feet], axis=-1)
        above = lowest > jnp.maximum(episode.floors, episode.ahead) + _CLEAR
        floors = jnp.where(above, episode.ahead, episode.floors)
        touching = lowest < floors + _CLEAR
        return episode._replace(floors=floors, ahead=jnp.where(touching, self._heights(sizes, drawn), episode.ahead))

    def push(self, state: State, drawn: jax.Array) -> jax.Array:
        """What a push of the next step adds to the root's velocity, ``[N, 6]``, zero where there is none."""
        push = state.share[:, None] * _push(state.sizes, drawn)
        return jnp.where((state.episode.wait <= 1)[:, None], push, 0.0)

    def sense(self, state: State, sim: PhysicsState, told: Any, drawn: jax.Array) -> tuple[jax.Array, State]:
        """The actor's observation ``[N, O]`` of states whose command is ``told [N, C]``, and what is now remembered."""
        qpos, qvel = self._measured(state, sim, drawn) if self.config.noisy else (sim.qpos, sim.qvel)
        if not self.deployable:
            own = features.observation(self.robot, qpos, qvel, self.form)
            return jnp.concatenate([own, told], axis=-1) if self.told else own, state
        slope = state.body.slope if self.config.bodies else jnp.zeros((len(qpos), 2))
        terms = (
            qvel[:, 3:6],
            rotations.rotate(rotations.conjugate(qpos[:, 3:7]), traits.gravity(slope)),
            *([told] if self.told else []),
            qpos[:, 7:] - self.actions.center,
            qvel[:, 6:],
            state.episode.sent[:, -1],
        )
        newest = jnp.concatenate(terms, axis=-1).astype(qpos.dtype)
        if self.history == 1:
            return newest, state
        episode = state.episode
        before = jnp.where(episode.fresh[:, None, None], newest[:, None], episode.sensed)
        every = jnp.concatenate([before, newest[:, None]], axis=1)
        episode = episode._replace(sensed=every[:, 1:], fresh=jnp.zeros_like(episode.fresh))
        # A term's whole history comes before the next term's.
        parts = jnp.split(every, np.cumsum(self._widths)[:-1], axis=-1)
        whole = jnp.concatenate([part.reshape(len(part), -1) for part in parts], axis=-1)
        return whole, state._replace(episode=episode)

    def reveal(self, state: State) -> jax.Array:
        """What of the disturbances the critic sees, ``[N, R]``: actions on their way, their delay, robot and floor."""
        sent, count = state.episode.sent, len(state.episode.sent)
        body = state.body
        shown = [body.friction, body.torso_mass, body.torso_center, body.slope] if self.config.bodies else []
        late = [state.episode.delay[:, None].astype(sent.dtype)] if self.config.delay else []
        floors = [state.episode.floors] if self.uneven else []
        return jnp.concatenate([sent.reshape(count, -1), *late, *shown, *floors], axis=-1)

    def standing(self, state: State, qpos: jax.Array) -> State:
        """The disturbances with last actions that hold the joints where they are, as in the midst of an episode."""
        held = (qpos[:, 7:] - self.actions.center) / self.actions.scale
        sent = jnp.broadcast_to(held[:, None], state.episode.sent.shape).astype(state.episode.sent.dtype)
        return state._replace(episode=state.episode._replace(sent=sent))

    def grow(self, state: State, surviving: jax.Array, wanted: float) -> State:
        """Larger pushes where more than the ``wanted`` share of the episodes survive, else smaller ones."""
        if not self.config.push_growth:
            return state
        step = jnp.where(surviving > wanted, self.config.push_growth, -self.config.push_growth)
        return state._replace(share=jnp.clip(state.share + step, self.config.push_start, 1.0))

    def _measured(self, state: State, sim: PhysicsState, drawn: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Positions and velocities with the errors of the sensors; root position and velocity are true."""
        error = 2.0 * drawn[:, _PUSH + _WAIT + _DELAY : self.draws] - 1.0
        turn, tilt, angle, velocity = jnp.split(state.sizes.noise, 4, axis=-1)
        about = jnp.concatenate([tilt * error[:, 3:5], jnp.zeros_like(tilt)], axis=-1)
        rotation = rotations.multiply(sim.qpos[:, 3:7], rotations.exp_map(about))
        angles, velocities = jnp.split(error[:, 5:], 2, axis=-1)
        joints = sim.qpos[:, 7:] + state.bias + angle * angles
        qpos = jnp.concatenate([sim.qpos[:, :3], rotation, joints], axis=-1)
        own = jnp.concatenate([turn * error[:, :3], velocity * velocities], axis=-1)
        return qpos, sim.qvel.at[:, 3:].add(own)


def make(config: Config, robot: Robot, actions: ActionMap, told: int) -> Disturbances | None:
    """The disturbances that a configuration asks for; None where it asks for none."""
    if not config.disturbance.any and config.env.observation != "deployable":
        return None
    return Disturbances(config, robot, actions, told)


def _check_torso(robot: Robot, config: DisturbanceConfig) -> None:
    torso, lightest = traits.torso_body(robot), min(config.torso_mass, default=0.0)
    mass = float(robot.model.body_mass[torso + 1])
    if mass + lightest <= 0:
        raise UserError(
            f"setting disturbance.torso_mass begins with {lightest:g}: expected more than {-mass:g} kg, since "
            f"the torso of {robot.name} has {mass:g} kg"
        )


def _sizes(config: DisturbanceConfig, rate: float, count: int) -> Sizes:
    noise = (config.turn_noise, config.tilt_noise, config.angle_noise, config.velocity_noise)
    pushed = bool(config.push_interval)
    sizes: dict[str, Any] = dict(
        delay=config.delay or (0, 0),
        noise=noise,
        interval=[max(1, round(rate * seconds)) for seconds in config.push_interval] if pushed else (_NEVER, _NEVER),
        speed=config.push_speed if pushed else (0.0, 0.0),
        spin=(config.push_lift, config.push_tilt, config.push_turn) if pushed else (0.0, 0.0, 0.0),
    )
    return Sizes(**{name: jnp.tile(jnp.asarray(size, jnp.float32), (count, 1)) for name, size in sizes.items()})


def _body(config: DisturbanceConfig, frictionloss: float, key: jax.Array, count: int, joints: int) -> Traits:
    """Robots and floors of ``count`` environments."""
    keys = iter(jax.random.split(key, 9))

    def drawn(ends: tuple[float, ...], width: int, otherwise: float) -> jax.Array:
        low, high = ends or (otherwise, otherwise)
        return low + (high - low) * jax.random.uniform(next(keys), (count, width))

    friction, mass = drawn(config.friction, 1, 1.0), drawn(config.torso_mass, 1, 0.0)
    off = jnp.asarray(config.torso_center or (0.0, 0.0, 0.0)) * drawn((-1.0, 1.0), 3, 0.0)
    factors = (drawn(ends, joints, 1.0) for ends in (config.stiffness, config.damping, config.strength))
    stiffness, damping, strength = factors
    joint_friction = drawn(config.joint_friction, joints, frictionloss)
    armature = drawn(config.armature, joints, 1.0)
    steep, way = jnp.split(drawn((0.0, 1.0), 2, 0.0), 2, axis=-1)
    slope = config.slope * steep * jnp.concatenate([jnp.cos(2 * jnp.pi * way), jnp.sin(2 * jnp.pi * way)], axis=-1)
    return Traits(friction, mass, off, stiffness, damping, strength, joint_friction, armature, slope, ())


def _push(sizes: Sizes, drawn: jax.Array) -> jax.Array:
    """What a push adds to the root's velocity, ``[N, 6]``: m/s in the world, rad/s about its own axes."""
    angle, speed = 2.0 * jnp.pi * drawn[:, 0], drawn[:, 1]
    speed = sizes.speed[:, 0] + speed * (sizes.speed[:, 1] - sizes.speed[:, 0])
    most = jnp.stack([sizes.spin[:, 0], sizes.spin[:, 1], sizes.spin[:, 1], sizes.spin[:, 2]], axis=-1)
    return jnp.concatenate(
        [(speed * jnp.cos(angle))[:, None], (speed * jnp.sin(angle))[:, None], most * (2.0 * drawn[:, 2:6] - 1.0)],
        axis=-1,
    )

"""The presets: where ``laptop`` and ``smoke`` depart from the paper's settings, and why."""

from collections.abc import Mapping
from typing import Any

from fmpjax.config.reading import validate, with_changes
from fmpjax.config.rewards import FOLLOWERS
from fmpjax.config.sections import Config
from fmpjax.errors import UserError

# What walks on two cores in a quarter of an hour.
_LAPTOP: dict[str, Any] = {
    "robot": "unitree_g1",  # the model that this preset was tuned with
    "precision": "default",  # a CPU computes in float32 all the same
    "transitions": 6_000_000,  # a quarter of an hour
    "evaluations": (0.2, 0.3, 0.4, 0.55, 0.7, 0.85, 1.0),  # none before a fifth of the budget
    "evaluation_episodes": 256,  # a quarter of the paper's, for time
    "chunk": 25,  # calls of about 100,000 transitions
    # Physics at 100 Hz without joint friction, with few solver iterations: three times the paper's rate on a CPU.
    "physics.timestep": 0.01,
    "physics.substeps": 2,
    "physics.iterations": 5,
    "physics.ls_iterations": 5,
    "physics.frictionloss": 0.0,
    "env.count": 128,  # many small policy updates in few transitions
    # A cap that grows with the robot's survival, a time-out being no end: docs/trials.md says what either does.
    "env.first_cap": 64,
    "env.last_cap": 150,
    "env.demonstration_parts": 1,  # samples alone, as when this preset was tuned
    "env.early_frames": False,  # no windows before it, as when this preset was tuned
    "env.observation": "compact",  # 86 numbers that carry what the 237 do: fewer to multiply
    # The first policy stands about upright: actions are around the demonstration's mean pose, each joint's as wide as a
    # quarter of what its motor can hold. So the policy is given that mean pose from the fixed pose, too.
    "env.action": "residual",
    # Coordinates that the demonstration hardly moves would carry the distance.
    "features.deviation_floor": 0.05,
    "features.angular_velocity_floor": 0.5,
    "prior.updates": 3,  # the reward changes little between rollouts of 4,096 transitions
    "prior.average_restarts": False,  # three updates are too few to average
    "prior.query_share": 1.0,  # every environment, as few as they are
    "prior.spread_floor": 1e-3,  # scores that differ by less are the fit's noise
    "amp.hidden": (256, 128),  # fewer to multiply, as in the policy
    "amp.updates": 3,  # as many as the potential's
    "amp.minibatch": 256,  # as many as the potential's
    "amp.replay": 40_000,  # ten rollouts
    "amp.optimizer": "adam",  # as the policy
    "amp.learning_rate": 1e-4,  # for Adam
    "gail.hidden": (256, 128),  # AMP's
    "gail.updates": 3,  # AMP's
    "gail.minibatch": 256,  # AMP's
    "gail.learning_rate": 1e-4,  # AMP's: 1e-5 hardly moves in so few updates
    "wail.hidden": (256, 128),  # AMP's
    "wail.minibatch": 256,  # AMP's
    # Pretraining takes seconds to minutes instead of hours on two cores: fewer and smaller iterations, at the larger
    # rate that the smaller network allows. It is not the published prior, and `smp.network` says so.
    "smp.network": "small",
    "smp.iterations": 2000,
    "smp.batch": 128,
    "smp.learning_rate": 1e-3,
    "smp.scale": 400.0,  # about e^6: an average window earns 1, which the critic finds, and not 0.0025
    "add.hidden": (256, 128),  # AMP's
    "add.updates": 3,  # AMP's
    "add.minibatch": 256,  # AMP's
    "add.replay": 40_000,  # AMP's
    "add.optimizer": "adam",  # AMP's
    "add.learning_rate": 1e-4,  # AMP's
    "ppo.hidden": (256, 128),  # fewer to multiply
    # Sample efficiency: a smooth activation, and exploration that is learned.
    "ppo.activation": "elu",
    "ppo.orthogonal": True,
    "ppo.deviation": 0.35,
    "ppo.learn_deviation": True,
    # Sample efficiency: Adam at a rate that follows the KL divergence, the critic's loss in units of the return's
    # variance, a gradient clip, and five passes of both.
    "ppo.optimizer": "adam",
    "ppo.learning_rate": 5e-4,
    "ppo.clip_norm": 1.0,
    "ppo.target_kl": 0.03,
    "ppo.critic_epochs": 5,
    "ppo.critic_batch": 8,
    "ppo.actor_epochs": 5,
    "ppo.actor_batch": 8,
    "ppo.discount": 0.97,  # a median-centered reward pays one per step for mere survival, worth 1 / (1 - gamma)
    "ppo.gae_lambda": 0.9,  # a policy gradient from so small a rollout is mostly noise
    "ppo.bound_penalty": 0.0,  # a residual that is too large is clipped at the joint's range
    # The first policy sees numbers of order one: the statistics start from the spread of the demonstration's states
    # and follow the policy's. So the policy is given that spread from the fixed pose, too, though never a state.
    "ppo.normalizer_from_clip": True,
    "ppo.normalizer_count": 2_000_000,
}

# The whole path, small: nothing is learned, everything runs. All that differs from ``laptop`` is for time.
_SMOKE: dict[str, Any] = _LAPTOP | {
    "transitions": 16 * 32 * 20,  # twenty rollouts
    "evaluations": (0.5, 1.0),  # one on the way and one at the end
    "evaluation_episodes": 8,
    "chunk": 5,  # four calls
    "env.count": 16,
    "prior.bank": 64,
    "prior.minibatch": 64,
    "prior.updates": 2,
    "prior.score_banks": 2,
    "amp.hidden": (64, 64),
    "amp.updates": 2,
    "amp.minibatch": 64,
    "amp.replay": 1000,  # two rollouts
    "gail.hidden": (64, 64),
    "gail.updates": 2,
    "gail.minibatch": 64,
    "wail.hidden": (64, 64),
    "wail.updates": 2,
    "wail.minibatch": 64,
    "smp.iterations": 20,
    "smp.batch": 32,
    "add.hidden": (64, 64),
    "add.updates": 2,
    "add.minibatch": 64,
    "add.replay": 1000,
    "ppo.hidden": (64, 64),
}

# Stays up where ``laptop`` falls, and observes what a robot senses.
_ROBUST: dict[str, Any] = _LAPTOP | {
    "transitions": 16_000_000,  # three quarters of an hour
    "env.observation": "deployable",  # no height and no linear velocity
    "env.axes": "heading",  # of what the critic observes: a push has any direction
    "features.axes": "heading",  # a push may turn the robot for good
    "disturbance.friction": (0.3, 1.5),  # as far as the evaluation goes; mjlab's is 0.3 to 1.2
    "disturbance.torso_mass": (-1.0, 3.0),  # unitree_rl_lab's and HoloSoma's
    "disturbance.torso_center": (0.025, 0.025, 0.03),  # mjlab's
    "disturbance.stiffness": (0.9, 1.1),  # HoloSoma's
    "disturbance.damping": (0.9, 1.1),  # HoloSoma's
    "disturbance.strength": (0.9, 1.0),  # a warm motor
    # No joint friction: its constraints cost a third of the rate.
    "disturbance.armature": (1.0, 1.05),  # Playground's
    "disturbance.slope": 0.03,  # a floor that is not level
    "disturbance.encoder_bias": 0.015,  # mjlab's
    "disturbance.delay": (0, 4),  # up to 40 ms, twice HoloSoma's
    "disturbance.turn_noise": 0.2,  # mjlab's
    "disturbance.tilt_noise": 0.05,  # mjlab's
    "disturbance.angle_noise": 0.01,  # mjlab's
    "disturbance.velocity_noise": 1.5,  # mjlab's
    "disturbance.push_interval": (1.0, 3.0),  # mjlab's
    "disturbance.push_speed": (0.0, 1.0),  # twice mjlab's
    "disturbance.push_lift": 0.4,  # mjlab's
    "disturbance.push_tilt": 0.52,  # mjlab's
    "disturbance.push_turn": 0.78,  # mjlab's
    "ppo.mirror": 1.0,  # a push comes from either side
    "ppo.estimator": (128, 64),  # a push is a velocity, which no sensor measures
    "ppo.discount": 0.985,  # a recovery takes a second
    "ppo.gae_lambda": 0.95,  # as the discount
    "ppo.settle": 0.2,  # smaller updates at the end: without them low friction and pushes bring it down more often
}

# What goes with a command unless it is set otherwise: neither the policy nor the prior knows which way is north.
COMMANDS: Mapping[str, Mapping[str, Any]] = {
    "none": {"command.kind": "none"},
    "velocity": {
        "command.kind": "velocity",
        "motion": "gaits",
        "env.axes": "heading",
        "features.axes": "heading",
        "env.last_cap": 500,  # falls of turns on the spot come after more than three seconds
        "command.hold": (1.0, 5.0),  # also turns on the spot that last
        "command.ramp": (1.0, 1.0),  # no robot turns from a fast walk to a turn on the spot at once
        "ppo.settle": 0.2,  # policies of nearby iterations otherwise fall in 0.1 to 4 % of the episodes
        "ppo.mirror": 1.0,  # else a policy learns the turn to one side better than the other, and falls
        "ppo.mirror_width": 0.3,  # a robot whose feet are side by side must choose which one steps first
        # Light pushes: a walk that becomes a turn on the spot goes through states that are rare without them.
        "disturbance.push_interval": (2.0, 4.0),
        "disturbance.push_speed": (0.0, 0.4),
        "disturbance.push_turn": 0.5,
    },
    "phase": {
        "command.kind": "phase",
        "env.axes": "heading",
        "features.axes": "heading",
        "env.last_cap": 500,  # a clip is longer than three seconds
    },
    "motion": {"command.kind": "motion", "env.axes": "heading", "features.axes": "heading"},
}

# What goes with a method that compares each step with the demonstration at the same time, unless it is set otherwise.
# Such a reward says itself how well the policy obeys.
_FOLLOWING = COMMANDS["phase"] | {"command.combine": "prior"}


def commanded(kind: str | None, changes: Mapping[str, Any], preset: str | None = None) -> dict[str, Any]:
    """Changes of the settings with those that go with a command; what is changed itself stays.

    Args:
      kind: of command; None leaves the command as it is.
      changes: by ``section.field`` keys.
      preset: its name, None for the default. Its own pushes, or a ``push_interval`` in ``changes``, replace those of
        the command.

    Raises:
      UserError: the kind is unknown.
    """
    if kind is None:
        return dict(changes)
    if kind not in COMMANDS:
        raise UserError(f"command is {kind!r}: expected one of {', '.join(COMMANDS)}")
    pushed = PRESETS.get(preset or "", {}).get("disturbance.push_interval") or "disturbance.push_interval" in changes
    return {**(_unpushed(COMMANDS[kind]) if pushed else COMMANDS[kind]), **changes}


def _unpushed(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in settings.items() if not key.startswith("disturbance.push_")}


PRESETS: Mapping[str, Mapping[str, Any]] = {
    "smoke": _SMOKE,
    "laptop": _LAPTOP,
    "robust": _ROBUST,
    "robot": _ROBUST | _unpushed(COMMANDS["velocity"]),
    "paper": {},
}
DESCRIPTIONS = {
    "smoke": "every step once, in a minute; learns nothing",
    "laptop": "walks after about a quarter of an hour on two cores",
    "robust": "`laptop` with disturbances, and only what a robot senses; three quarters of an hour",
    "robot": "`robust`, and steered by commanded velocities: for a real robot",
    "paper": "the paper's setting, for an accelerator",
}


def preset(name: str, /, **changes: Any) -> Config:
    """A preset's configuration with changes, given as ``section.field`` keys.

    A method that compares each step with the demonstration at the same time brings the command `phase` with it.

    Raises:
      UserError: unknown preset or field, or a value that the field cannot have.
    """
    if name not in PRESETS:
        raise UserError(f"unknown preset {name!r}: expected one of {', '.join(PRESETS)}")
    implied = _FOLLOWING if changes.get("method") in FOLLOWERS else {}
    return validate(with_changes(Config(preset=name), {**PRESETS[name], **implied, **changes}))

"""The numbers of the method that can be set, each once, with its source; and the presets.

Numbers that cannot be set stand where they are used. They define a figure (at the top of `metrics` and `evaluate`), are
part of a formula (in `env`, `ppo`, `features`, `transport`, `potential` and `priors`) or size a study (`experiments`).
"""

from fmpjax.config.disturbance import DisturbanceConfig
from fmpjax.config.presets import COMMANDS, DESCRIPTIONS, PRESETS, commanded, preset
from fmpjax.config.reading import flatten, from_json, read, to_json, validate, with_changes
from fmpjax.config.rewards import (
    FOLLOWERS,
    SMP_NETWORKS,
    ADDConfig,
    AdversaryConfig,
    AMPConfig,
    GAILConfig,
    PWILConfig,
    SMPConfig,
    TrackingConfig,
    WAILConfig,
)
from fmpjax.config.sections import (
    CommandConfig,
    Config,
    EnvConfig,
    FeatureConfig,
    PhysicsConfig,
    PPOConfig,
    PriorConfig,
)

__all__ = [
    "COMMANDS",
    "DESCRIPTIONS",
    "FOLLOWERS",
    "PRESETS",
    "SMP_NETWORKS",
    "ADDConfig",
    "AMPConfig",
    "AdversaryConfig",
    "CommandConfig",
    "Config",
    "DisturbanceConfig",
    "EnvConfig",
    "FeatureConfig",
    "GAILConfig",
    "PPOConfig",
    "PWILConfig",
    "PhysicsConfig",
    "PriorConfig",
    "SMPConfig",
    "TrackingConfig",
    "WAILConfig",
    "commanded",
    "flatten",
    "from_json",
    "preset",
    "read",
    "to_json",
    "validate",
    "with_changes",
]

"""The least main memory that a run needs, checked before it starts: the system kills a process that takes too much.

On an accelerator nothing is estimated: its allocator refuses with an error, of which `fmpjax.runs` makes a sentence.
"""

import jax

from fmpjax import features, machine, robots
from fmpjax.config import FOLLOWERS, SMP_NETWORKS, AdversaryConfig, Config
from fmpjax.errors import UserError


def parts(config: Config, seeds: int = 1, windows: int = 0) -> dict[str, int]:
    """The least bytes that a training program needs, by the setting that they grow with.

    Args:
      config: of the run.
      seeds: runs at once.
      windows: of the demonstrations, from which the prior learns; 0 where they are not known, and not counted.

    Only large arrays that exist at the same time are counted. The compiled programs that were measured (in
    ``tests/test_memory.py``) take 1.1 to 2.7 times the sum.
    """
    prior = config.prior
    window = 4 * config.features.history * len(features.compact_weights(robots.load(config.robot)))  # float32
    copies = 2  # a rollout's windows, and once more on their way through the prior
    if config.method in FOLLOWERS:
        # Single frames, those that were wanted, their differences, and once more in another order.
        window, copies = window // config.features.history, 4
    needed = {"env.count": copies * config.transitions_per_iteration * window}
    section = getattr(config, config.method, None)
    if isinstance(section, AdversaryConfig):
        kinds = 3 if section.replay else 2
        needed[f"{config.method}.replay"] = section.replay * window // 2  # float16
        needed[f"{config.method}.minibatch"] = (kinds + 1) * section.minibatch * window  # kinds of windows, and slopes
    elif config.method == "smp":
        layers, heads, head_width = SMP_NETWORKS[config.smp.network]
        layer = 4 * config.features.history * heads * head_width  # float32
        needed["env.count"] *= 2  # the windows beside the demonstration's, and their noise
        # The gated layer's two halves, four times as wide. Scoring keeps no layer; pretraining keeps all, and slopes.
        needed["smp.score_batch"] = min(config.smp.score_batch, config.transitions_per_iteration) * 8 * layer
        needed["smp.batch"] = config.smp.batch * 36 * layers * layer
        del needed[min(("smp.score_batch", "smp.batch"), key=needed.__getitem__)]  # one after the other
    elif config.method == "pwil":
        # What each window of the demonstration holds for each environment before the rollout; and within it, when the
        # rollout's windows are there once.
        masses, rollout = 4 * config.env.count * windows, needed["env.count"] // 2
        needed["env.count"] = masses + max(2 * rollout, rollout + masses)
    elif section is None:  # a transport
        needed["prior.bank"] = 2 * 4 * prior.bank**2  # costs to another bank and to itself
    if config.method in ("fmp", "endpoint", "value"):
        # Queries, targets, points and their slopes; costs to both banks.
        needed["prior.minibatch"] = prior.minibatch * (8 * window + 2 * 4 * prior.bank)
    return {setting: seeds * size for setting, size in needed.items()}


def check(config: Config, seeds: int = 1, windows: int = 0) -> None:
    """Raise a `UserError` where a run, or one of so many seeds at once, cannot fit this machine's memory.

    The arguments are those of `parts`. What is let through may still not fit: the estimate is a lower bound. Processes
    that train together share the work.
    """
    if jax.default_backend() != "cpu":
        return
    needed = {setting: size // jax.process_count() for setting, size in parts(config, seeds, windows).items()}
    has = machine.memory()
    if has is None or sum(needed.values()) <= has:
        return
    largest = max(needed, key=needed.__getitem__)
    section, _, field = largest.partition(".")
    several = f", or --seeds (now {seeds})" if seeds > 1 else ""
    raise UserError(
        f"the run needs at least {_gib(sum(needed.values()))} of memory and this machine has {_gib(has)}: expected a "
        f"smaller {largest} (now {getattr(getattr(config, section), field)}){several}"
    )


def _gib(size: int) -> str:
    return f"{size / 2**30:,.1f} GiB"

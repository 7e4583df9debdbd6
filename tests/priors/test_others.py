"""GAIL, WAIL, PWIL and SMP against closed forms, and all of them in one iteration of training."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fmpjax import config as configuration
from fmpjax import motion, priors, transport
from fmpjax.config import preset
from fmpjax.errors import UserError
from fmpjax.priors import MotionPrior, Rollout, pwil, smp, wail
from fmpjax.trainer import Trainer
from tests.helpers import COUNT, SMALL, STEPS, expert_of, rollout_of, tiny


def changed(section, **values):
    return dataclasses.replace(SMALL, **{section: dataclasses.replace(getattr(SMALL, section), **values)})


def quantiles(count, mean, deviation):
    """Points ``[count, 1]`` evenly spread over a Gaussian's mass."""
    return mean + deviation * jax.scipy.stats.norm.ppf((jnp.arange(count) + 0.5) / count)[:, None]


# --- GAIL ------------------------------------------------------------------------------------------------------------


def test_gail_finds_the_log_odds_of_two_gaussians():
    """N(1/2, 1) against N(-1/2, 1): log p_E(x) - log p_A(x) = x, and the reward is log(1 + e^x)."""
    config = changed("gail", hidden=(), updates=150, minibatch=256, learning_rate=0.03, logit_init=0.01)
    prior = priors.make("gail", expert_of(quantiles(256, 0.5, 1.0)), config)
    rollout = rollout_of(quantiles(STEPS * COUNT, -0.5, 1.0))
    update, state = jax.jit(prior.update), prior.init(jax.random.PRNGKey(0))
    for seed in range(3):
        state, _, metrics = update(state, rollout, jax.random.PRNGKey(seed))
    x = jnp.linspace(-2.0, 2.0, 9)[:, None]
    np.testing.assert_allclose(prior.score(state, x), x[:, 0], atol=0.25)
    _, reward, _ = update(state, rollout, jax.random.PRNGKey(9))
    scores = np.asarray(prior.score(state, rollout.features.reshape(-1, 1)))
    np.testing.assert_allclose(reward.ravel(), np.log1p(np.exp(scores)), rtol=1e-5)
    # The optimum's cross entropy, E log(1 + e^-x) under N(1/2, 1), by quadrature.
    expected = np.log1p(np.exp(-np.asarray(quantiles(10_000, 0.5, 1.0)))).mean()
    assert float(metrics["discriminator_loss"]) == pytest.approx(expected, abs=0.03)


# --- WAIL ------------------------------------------------------------------------------------------------------------


def test_wail_loss_of_a_linear_critic_by_hand():
    """D = 3 x, agent at -1, demonstration at 1: -(3 + 3) + 10 (3 - 1)^2 = 34."""
    apply = lambda w, x: w * x[:, 0]  # noqa: E731
    total, stats = wail.loss(
        apply, 3.0, -jnp.ones((4, 1)), jnp.ones((4, 1)), jax.random.PRNGKey(0), configuration.WAILConfig()
    )
    assert float(total) == pytest.approx(34.0, rel=1e-5)
    expected = {"critic_difference": 6.0, "gradient_penalty": 4.0, "critic_slope": 3.0}
    assert {name: float(value) for name, value in stats.items()} == pytest.approx(expected, rel=1e-5)


def test_wail_critic_between_two_points_has_slope_one():
    """Points at distance L: -L s + 10 (s - 1)^2 is least at s = 1 + L / 20, which the penalty lets through.

    The points are at -1/2 and 1/2. The normalizer divides by their deviation, 1/2, so L = 2 there.
    """
    config = changed("wail", hidden=(32,), updates=150, minibatch=64, learning_rate=5e-3)
    prior = priors.make("wail", expert_of(np.full((32, 1), 0.5)), config)
    rollout = rollout_of(np.full((STEPS * COUNT, 1), -0.5))
    update, state = jax.jit(prior.update), prior.init(jax.random.PRNGKey(0))
    for seed in range(5):
        state, _, metrics = update(state, rollout, jax.random.PRNGKey(seed))
    values = np.asarray(prior.score(state, jnp.linspace(-0.4, 0.4, 5)[:, None]))
    np.testing.assert_allclose(np.diff(values) / 0.4, 1.1, atol=0.05)  # steps of 0.2 / 0.5
    assert float(metrics["critic_slope"]) == pytest.approx(1.1, abs=0.02)
    assert float(metrics["critic_difference"]) == pytest.approx(2.2, abs=0.05)  # slope times L


def test_wail_reward_does_not_depend_on_the_critics_level_and_divides_by_a_running_deviation():
    """2 sigmoid((D - mean) / deviation): the first rollout's own deviation, then a mean over rollouts of variances."""
    expert = expert_of(np.zeros((8, 1)))
    prior = priors.make(
        "wail", expert, changed("wail", hidden=(), updates=1, learning_rate=1e-9, deviation_half_life=1.0)
    )
    points = np.random.default_rng(0).normal(size=(STEPS * COUNT, 1))
    update, state = jax.jit(prior.update), prior.init(jax.random.PRNGKey(0))
    # The normalizer that scores the second rollout is the first's.
    new, first, _ = update(state, rollout_of(points), jax.random.PRNGKey(1))
    shifted = new._replace(critic=new.critic._replace(params=jax.tree.map(lambda x: x, new.critic.params)))
    shifted.critic.params["params"]["logit"]["bias"] += 50.0
    _, second, metrics = update(new, rollout_of(3 * points), jax.random.PRNGKey(2))
    _, level, _ = update(shifted, rollout_of(3 * points), jax.random.PRNGKey(2))
    np.testing.assert_allclose(level, second, atol=1e-4)
    one, other = (
        np.asarray(prior.score(s, jnp.asarray(k * points, jnp.float32)), float) for s, k in ((state, 1), (new, 3))
    )
    running = math.sqrt(0.5 * one.var() + 0.5 * other.var())
    for reward, values, deviation in ((first, one, one.std()), (second, other, running)):
        expected = 2 / (1 + np.exp(-(values - values.mean()) / deviation))
        np.testing.assert_allclose(np.ravel(reward), expected, atol=1e-4)
    assert float(metrics["reward_deviation"]) == pytest.approx(running, rel=1e-4)


# --- PWIL ------------------------------------------------------------------------------------------------------------


def greedy(features, starts, atoms, steps, slack=1e-6, scale=5.0, decay=5.0):
    """Rewards ``[T]`` of one environment by the definition, atom by atom; and the most atoms that a step took."""
    rewards, most, mass = [], 0, np.full(len(atoms), 1 / len(atoms))
    for x, start in zip(features, starts, strict=True):
        if start:
            mass = np.full(len(atoms), 1 / len(atoms))
        distance, left, cost, taken = np.linalg.norm(atoms - x, axis=1), 1 / steps - slack, 0.0, 0
        for atom in np.argsort(distance):
            if left > 0 and mass[atom] > 0:
                moved = min(left, mass[atom])
                mass[atom], left, cost, taken = (
                    mass[atom] - moved,
                    left - moved,
                    cost + moved * distance[atom],
                    taken + 1,
                )
        rewards.append(scale * math.exp(-decay * steps * cost) if left <= 0 else 0.0)
        most = max(most, taken)
    return np.array(rewards), most


@pytest.mark.parametrize("atoms", [5, 8, 30])
def test_pwil_is_the_greedy_coupling_of_each_episode(atoms):
    """Episodes that start anywhere, over two rollouts, against the definition; one is longer than the mass lasts."""
    rng = np.random.default_rng(atoms)
    config = dataclasses.replace(SMALL, env=dataclasses.replace(SMALL.env, count=4, first_cap=4, last_cap=STEPS))
    windows = 0.3 * rng.normal(size=(atoms, 2))
    prior = priors.make("pwil", expert_of(windows), config)
    features = 0.3 * rng.normal(size=(2 * STEPS, 4, 2))
    starts = rng.uniform(size=(2 * STEPS, 4)) < 0.2
    starts[0], starts[STEPS - 2, 1], starts[STEPS, 0] = True, True, True  # one goes on over the rollouts' border
    starts[STEPS, 1] = False
    update, state, rewards = jax.jit(prior.update), prior.init(jax.random.PRNGKey(0)), []
    for half in (slice(0, STEPS), slice(STEPS, None)):
        rollout = Rollout(
            jnp.asarray(features[half], jnp.float32), jnp.ones((STEPS, 4), bool), jnp.asarray(starts[half])
        )
        state, reward, metrics = update(state, rollout, jax.random.PRNGKey(0))
        rewards.append(reward)
    expected = np.stack([greedy(features[:, i], starts[:, i], windows, STEPS)[0] for i in range(4)], axis=1)
    np.testing.assert_allclose(np.concatenate(rewards), expected, rtol=1e-3, atol=1e-5)
    assert 0 <= float(metrics["mass_held"]) <= 1


def test_pwil_takes_as_many_atoms_as_it_needs():
    """Three atoms and three steps: the last takes what the first two left, so three atoms and not 3 / 3 + 1."""
    atoms, points = np.array([[0.0], [1.0], [3.0]]), np.array([[0.0], [1.0], [0.1]])
    expected, most = greedy(points, [True, False, False], atoms, 3, slack=0.01)
    assert most == 3
    mass, costs = jnp.full((1, 3), 1 / 3), []
    for point in points:
        distance = jnp.sqrt(2 * transport.squared_cost(jnp.asarray(point[None]), jnp.asarray(atoms)))
        cost, mass, _ = pwil.couple(distance, mass, 1 / 3 - 0.01)
        costs.append(float(cost[0]))
    np.testing.assert_allclose(5 * np.exp(-15 * np.array(costs)), expected, rtol=1e-4)
    np.testing.assert_allclose(mass[0], [0.0, 0.0, 0.03], atol=1e-6)


def test_pwil_ends_where_the_demonstration_is_spent():
    """A step that asks for more than is left takes what there is, and says how much is missing."""
    cost, mass, left = pwil.couple(jnp.array([[1.0, 2.0], [1.0, 2.0]]), jnp.array([[0.1, 0.1], [0.5, 0.5]]), 0.5)
    np.testing.assert_allclose(cost, [0.3, 0.5], rtol=1e-6)
    np.testing.assert_allclose(mass, [[0, 0], [0, 0.5]], atol=1e-7)
    np.testing.assert_allclose(left, [0.3, 0.0], atol=1e-7)


def test_pwil_rewards_no_step_for_which_too_little_is_left():
    """Standing on the only atom earns 5 for each of the eight steps of the longest episode, and then nothing."""
    config = dataclasses.replace(SMALL, env=dataclasses.replace(SMALL.env, count=1, first_cap=STEPS, last_cap=STEPS))
    prior = priors.make("pwil", expert_of(np.zeros((1, 2))), config)
    start = jnp.arange(STEPS + 2)[:, None] == 0
    rollout = Rollout(jnp.zeros((STEPS + 2, 1, 2)), jnp.ones_like(start), start)
    _, reward, metrics = prior.update(prior.init(None), rollout, None)
    np.testing.assert_allclose(reward[:, 0], [5.0] * STEPS + [0.0] * 2, atol=1e-5)
    assert float(metrics["mass_held"]) >= 0


def test_the_critic_has_a_clock_where_the_reward_remembers_the_episode():
    settings = {"env.first_cap": 5, "env.last_cap": 40, "env.episode_steps": 30}
    clocks = {name: Trainer(tiny(method=name, **settings), motion.load("walk")).ppo.clock for name in ("fmp", "pwil")}
    assert clocks == {"fmp": 0, "pwil": 30}


def test_pwil_refuses_a_rollout_that_does_not_say_where_episodes_start():
    prior = priors.make("pwil", expert_of(np.zeros((4, 2))), SMALL)
    state = prior.init(jax.random.PRNGKey(0))
    rollout = rollout_of(np.zeros((STEPS * COUNT, 2)))
    with pytest.raises(ValueError, match="without starts"):
        prior.update(state, rollout._replace(start=None), None)


# --- SMP -------------------------------------------------------------------------------------------------------------


def test_smp_schedule_is_the_squared_cosine():
    left = smp.schedule(50)
    at = (np.array([1, 9, 16, 23, 49]) / 50 + 0.008) / 1.008 * np.pi / 2
    np.testing.assert_allclose(left[[0, 8, 15, 22, 48]], np.cos(at) ** 2 / np.cos(0.008 / 1.008 * np.pi / 2) ** 2)
    assert left[-1] == pytest.approx(left[-2] / 1000)


def optimum(left, deviation):
    """Error of the best guess of the noise in N(0, deviation^2) with noise: its variance given the noised value."""
    return left * deviation**2 / (left * deviation**2 + 1 - left)


def test_smp_error_of_the_best_denoiser_is_the_closed_form():
    left, deviation = 0.6, 1.5
    x, noise = np.random.default_rng(0).normal(size=(2, 20_000, 2)) * np.array([deviation, 1.0])[:, None, None]
    best = lambda y, step: y * math.sqrt(1 - left) / (left * deviation**2 + 1 - left)  # noqa: E731
    error = smp.denoising_error(best, jnp.asarray(x), jnp.asarray(noise), 0, left)
    assert error.mean() == pytest.approx(optimum(left, deviation), rel=0.02)


def test_smp_learns_a_gaussian_to_the_closed_form_and_stays():
    """Windows of two frames from N(0, 1): the error at a noise step tends to the share of the signal left there."""
    rng = np.random.default_rng(1)
    windows, points = rng.normal(size=(4096, 2)) / math.sqrt(2), rng.normal(size=(STEPS * COUNT, 2)) / math.sqrt(2)
    config = changed("smp", iterations=600, batch=128, learning_rate=3e-3, average=0.98, scale=10.0)
    prior = priors.make("smp", expert_of(windows, horizon=2), config)
    update = jax.jit(prior.update)
    state, reward, metrics = update(prior.init(jax.random.PRNGKey(0)), rollout_of(points), jax.random.PRNGKey(1))
    assert int(state.iteration) == 600 and float(metrics["skipped"]) == 0
    left = smp.schedule(50)[[22, 15, 8]]
    expected = optimum(left, 1.0)
    assert float(metrics["expert_error"]) == pytest.approx(expected.mean(), rel=0.04)
    np.testing.assert_allclose(state.error, expected, rtol=0.15)  # of 256 windows
    # Errors relative to their own mean are 1 on average: E log (r / scale) = -6.
    assert np.log(np.maximum(reward / 10, 1e-30)).mean() == pytest.approx(-6.0, rel=1e-3)
    # What is far off is found out; what was pretrained does not change, the mean of errors is over both rollouts.
    far, worse, later = update(state, rollout_of(points + 5.0), jax.random.PRNGKey(2))
    assert worse.mean() < 0.1 * reward.mean()
    for name in ("params", "average", "optimizer", "iteration", "loss"):
        jax.tree.map(np.testing.assert_array_equal, getattr(far, name), getattr(state, name))
    assert float(far.seen) == 2 * STEPS * COUNT
    assert float(far.error.mean()) == pytest.approx(
        0.5 * (float(metrics["denoising_error"]) + float(later["denoising_error"])), rel=1e-4
    )


# --- training and settings -------------------------------------------------------------------------------------------


def test_each_trains_through_the_trainer():
    """All four in one compiled iteration, the policy rewarded by their sum; the rollout tells where episodes start."""
    names = ("gail", "wail", "pwil", "smp")
    trainer = Trainer(tiny(chunk=1, **{"smp.iterations": 3, "env.first_cap": 5}), motion.load("walk"))
    parts = {name: priors.make(name, trainer.prior_expert, trainer.config) for name in names}

    def update(state, rollout, key):
        found = {name: part.update(state[name], rollout, key) for name, part in parts.items()}
        metrics = {f"{name}/{k}": v for name, (_, _, values) in found.items() for k, v in values.items()}
        metrics |= {f"{name}/reward": reward.mean() for name, (_, reward, _) in found.items()}
        metrics["starts"] = rollout.start.sum()
        return {name: new for name, (new, _, _) in found.items()}, sum(r for _, r, _ in found.values()), metrics

    init = lambda key: {name: part.init(key) for name, part in parts.items()}  # noqa: E731
    trainer.prior = MotionPrior(init, update, None)
    state = trainer.init()
    new, metrics = jax.jit(trainer.iteration)(state)
    fit = {name.removeprefix("fit/"): float(value) for name, value in metrics.items() if name.startswith("fit/")}
    assert all(map(math.isfinite, fit.values())), fit
    assert fit["starts"] == 8 * 2  # eight environments, eight steps: an episode of five and one that goes on
    for name in names:
        assert fit[f"{name}/reward"] > 0
        same = jax.tree.map(lambda a, b: np.array_equal(a, b), new.prior[name], state.prior[name])
        assert not all(jax.tree.leaves(same)), name
    assert int(new.prior["smp"].iteration) == 3
    assert float(new.prior["pwil"].mass.min(axis=0).sum()) < 1.0
    assert any(
        not np.array_equal(a, b)
        for a, b in zip(jax.tree.leaves(new.ppo.actor), jax.tree.leaves(state.ppo.actor), strict=True)
    )


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("smp.network", "tiny", "setting smp.network is 'tiny': expected one of published, small"),
        ("smp.score_steps", "8,50", "smp.score_steps is 8, 50: expected noise steps from 0 to 49"),
        ("smp.average", 1.0, "smp.average is 1.0: expected a number of at least 0 and below 1"),
        ("wail.gradient_penalty", -1.0, "wail.gradient_penalty is -1.0: expected a number of at least 0"),
        ("gail.updates", 0, "gail.updates is 0: expected a whole number of at least 1"),
        ("pwil.scale", 0.0, "pwil.scale is 0.0: expected a number above 0"),
        ("pwil.slack", 0.1, "pwil.slack is 0.1: expected less than 0.00666667, the mass of one of the 150 steps"),
    ],
)
def test_bad_settings_are_named(key, value, words):
    with pytest.raises(UserError, match=words):
        preset("laptop", **{"method": "pwil", key: value})


def test_a_smaller_diffusion_network_is_called_small():
    assert [preset(name).smp.network for name in ("paper", "laptop", "smoke")] == ["published", "small", "small"]

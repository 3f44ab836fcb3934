"""LQR, random actions, and the interface that all baselines share."""

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from lagros_envs.dynamics import hold_step
from lagros_envs.registry import find_task
from lagros_envs.tasks.cartpole.env import CartPoleEnv
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_envs.tasks.cartpole.vector import CartPoleVectorEnv
from lagros_policies.actor import PpoPolicy, SacPolicy, Td3Policy
from lagros_policies.baselines import LqrPolicy, RandomPolicy, regulator_weights
from lagros_policies.residual import ResidualPolicy
from lagros_policies.sb3_model import StableBaselines3Policy


@pytest.fixture
def observations():
    env = CartPoleVectorEnv(200, disturbance="sphere", autoreset_mode="disabled")
    observation, _ = env.reset(seed=3)
    rng = np.random.default_rng(4)
    for _ in range(5):
        observation, *_ = env.step(rng.uniform(-1.0, 1.0, (200, 1)))
    return observation


@pytest.fixture(scope="module")
def model():
    return PPO("MlpPolicy", CartPoleEnv(), policy_kwargs={"net_arch": [8]}, device="cpu", seed=0)


# LQR


@pytest.mark.parametrize("settings", [CartPoleSettings(), CartPoleSettings(control_period=0.05)])
def test_the_lqr_gain_is_the_limit_of_the_riccati_recursion(settings):
    policy = LqrPolicy(settings, state_weights=[0.3, 2.0, 0.1, 0.5], force_weight=0.02)
    # Central differences of the true step instead of its linearisation.
    step = 1e-5
    points = step * np.concatenate([np.eye(5), -np.eye(5)])
    ends = hold_step(settings.system, points[:, :4], points[:, 4:], settings.control_period)
    slopes = ((ends[:5] - ends[5:]) / (2.0 * step)).T
    A, B = slopes[:, :4], slopes[:, 4:]
    Q, R = np.diag([0.3, 2.0, 0.1, 0.5]), np.array([[0.02]])
    P = Q
    for _ in range(2000):
        K = np.linalg.inv(R + B.T @ P @ B) @ B.T @ P @ A
        P = Q + K.T @ R @ K + (A - B @ K).T @ P @ (A - B @ K)
    np.testing.assert_allclose(policy.gain, K, rtol=1e-6)
    assert np.max(np.abs(np.linalg.eigvals(A - B @ policy.gain))) < 1.0


def test_lqr_weights_follow_brysons_rule():
    settings = CartPoleSettings()
    angle = settings.initial_angle
    weights = [1 / 25, 1 / angle**2, 1 / 25, 1 / angle**2]
    by_hand = LqrPolicy(settings, state_weights=weights, force_weight=1 / 1600)
    np.testing.assert_allclose(LqrPolicy(settings).gain, by_hand.gain, rtol=1e-12)


def test_lqr_brings_the_cart_to_the_goal_and_no_force_unit_changes_that():
    for scale in (40.0, 7.0):
        settings = CartPoleSettings(force_scale=scale)
        policy = LqrPolicy(settings, force_weight=1 / 1600)
        env = CartPoleEnv(settings=settings)
        options = {"initial_state": [0.0, 0.3, 0.0, 0.0], "goal": 1.0}
        observation, _ = env.reset(seed=0, options=options)
        for _ in range(settings.steps):
            action, _ = policy.predict(observation)
            observation, _, fallen, _, info = env.step(action)
            assert not fallen
        assert info["goal_distance"] < 0.05
        assert info["effort"] == pytest.approx(10.4, abs=3.0)


@pytest.mark.parametrize(
    "weights",
    [
        {"state_weights": [1.0, 1.0, 1.0]},
        {"state_weights": [0.0, 1.0, 1.0, 1.0]},
        {"state_weights": [1.0, -1.0, 1.0, 1.0]},
        {"state_weights": [1.0, np.nan, 1.0, 1.0]},
        {"force_weight": 0.0},
        {"force_weight": np.inf},
    ],
)
def test_lqr_rejects_weights_without_a_solution(weights):
    with pytest.raises(ValueError, match="must be"):
        LqrPolicy(**weights)


# Random


def test_random_draws_are_its_own_and_follow_the_seed():
    observation = np.zeros((500, 13), np.float32)
    first, again, other = (RandomPolicy(seed=seed).predict(observation)[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.any(first != other)
    assert np.all(np.abs(first) <= 1.0)
    assert abs(float(first.mean())) < 0.1
    assert float(first.std()) == pytest.approx(1 / np.sqrt(3), abs=0.05)


# The common interface


def all_policies(model):
    return [
        LqrPolicy(),
        RandomPolicy(seed=0),
        PpoPolicy(),
        SacPolicy(),
        Td3Policy(),
        ResidualPolicy(),
        StableBaselines3Policy(model, "model"),
    ]


def test_every_policy_keeps_the_contract(model, observations):
    for policy in all_policies(model):
        assert policy.observes == "local"
        single, memory = policy.predict(observations[0])
        assert (single.shape, single.dtype, memory) == ((1,), np.float32, None)
        kept = single.copy()
        batch, memory = policy.predict(observations, None, np.ones(len(observations), bool))
        assert (batch.shape, batch.dtype, memory) == ((len(observations), 1), np.float32, None)
        assert np.all(np.isfinite(batch))
        np.testing.assert_array_equal(single, kept)
        if policy.name != "random":
            np.testing.assert_allclose(batch[0], single, atol=1e-6)
            policy.predict(observations[1])
            np.testing.assert_array_equal(single, kept)


def test_stable_baselines3_evaluates_every_policy(model):
    env = Monitor(CartPoleEnv(disturbance="uniform"))
    for policy in all_policies(model):
        env.reset(seed=1)
        rewards, lengths = evaluate_policy(
            policy, env, n_eval_episodes=2, return_episode_rewards=True
        )
        assert len(rewards) == len(lengths) == 2
        assert np.all(np.isfinite(rewards))
        if policy.name not in ("random", "model"):
            assert lengths == [90, 90]


def test_a_regulator_of_the_goal_takes_weights_of_its_own_and_the_others_do_not():
    task = find_task("quadrotor")
    assert task.regulator != task.feedback == regulator_weights(task)
    state, control = task.regulator.state_weights, task.regulator.control_weights
    asked = LqrPolicy(task, state_weights=state, control_weights=control)
    np.testing.assert_array_equal(LqrPolicy(task).gain, asked.gain)
    assert not np.allclose(LqrPolicy(task, control_weights=0.03).gain, asked.gain)

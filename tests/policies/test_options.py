"""The paper's remarks as policies: built by name, flown in the ordinary environments."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import lagros_envs  # noqa: F401
import lagros_policies
from lagros_benchmarks.tasks.spacecraft.claims import position_margin
from lagros_envs.tasks.cartpole import task
from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.contraction.control import HeldControl
from lagros_policies.remarks.lagrangian import SlidingAxis, steady_position_bound
from lagros_policies.tasks.cartpole.neural.metric import NeuralMetric, load_neural_metric
from lagros_policies.tube_mpc import TubeMpcPolicy

NEURAL = "lagros_policies.tasks.cartpole.remarks:NeuralTubeMpcPolicy"
ADAPTIVE = "lagros_policies.tasks.cartpole.remarks:AdaptiveTubeMpcPolicy"
SLIDING = "lagros_policies.tasks.spacecraft.sliding:SlidingCentralizedPolicy"


@pytest.fixture(scope="module")
def model() -> Any:
    """The environment whose system every policy here believes in."""
    return gym.make("lagros/CartPole-v0")


def fly(policy: Any, seed: int, **changed: float) -> tuple[bool, Any, list[float]]:
    """Fly an episode of a true system; return strict success, memory and ||x - x_d||."""
    truth = task.CartPoleSettings(system=replace(CartPole(), **changed))
    env: Any = gym.make("lagros/CartPole-v0", settings=truth).unwrapped
    rows, _ = env.reset(seed=seed)
    memory: Any = None
    errors: list[float] = []
    over = False
    for step in range(truth.steps):
        action, memory = policy.predict(rows, memory, np.array([step == 0]))
        errors.append(float(np.linalg.norm(env.state - memory[0].tracked.states[0, step])))
        rows, _, over, _, info = env.step(action)
        if over:
            break
    return bool(info["inside_tube"]) and not over, memory, errors


def test_tube_mpc_takes_any_metric_and_the_option_takes_the_network(model: Any) -> None:
    named: Any = lagros_policies.make(NEURAL, model, deadline=1e9)
    given: Any = lagros_policies.make("tube-mpc", model, metric=load_neural_metric(), deadline=1e9)
    shipped: Any = lagros_policies.make("tube-mpc", model, deadline=1e9)
    rows = np.zeros((1, task.OBSERVATION_DIM), np.float32)
    rows[0, task.INITIAL_STATE], rows[0, task.GOAL] = [0.0, 0.3, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0]
    rows[0, task.STATE] = [0.1, 0.4, 0.0, 0.3]
    forces = [policy.predict(rows)[0][0, 0] for policy in (named, given, shipped)]
    assert isinstance(named.expert.metric, NeuralMetric)
    assert forces[0] == forces[1]
    # The force is u* of the network, not of the polynomial.
    state, memory = rows[0, task.STATE].astype(float), named.predict(rows)[1][0]
    law = HeldControl(CartPole(), load_neural_metric(), 0.3, 0.1)
    arguments = state, memory.plan.states[0], memory.plan.controls[0]
    least = law(*arguments)
    assert abs(least - HeldControl(CartPole(), shipped.expert.metric, 0.3, 0.1)(*arguments)) > 1e-3
    assert fly(named, 1)[0]


def test_a_file_that_is_no_network_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        lagros_policies.make(NEURAL, gym.make("lagros/CartPole-v0"), metric=tmp_path / "none")


@pytest.mark.parametrize(
    ("changed", "seed"), [({"cart_friction": 2.0}, 1), ({"cart_mass": 2.0}, 2)]
)
def test_the_adaptive_policy_learns_what_tube_mpc_cannot_stand(
    model: Any, changed: dict[str, float], seed: int
) -> None:
    adaptive = lagros_policies.make(ADAPTIVE, model, deadline=1e9)
    without = lagros_policies.make("tube-mpc:tuned", model, deadline=1e9)
    done, memory, errors = fly(adaptive, seed, **changed)
    lost, _, others = fly(without, seed, **changed)
    assert done
    assert not lost
    assert np.sqrt(np.mean(np.square(errors))) < 0.5 * np.sqrt(np.mean(np.square(others)))
    assert np.abs(memory[0].estimate).max() > 0.03


def test_the_estimate_belongs_to_a_row_and_an_episode(model: Any) -> None:
    policy: Any = lagros_policies.make(ADAPTIVE, model, deadline=1e9)
    rows = np.zeros((2, task.OBSERVATION_DIM), np.float32)
    rows[:, task.GOAL] = [2.0, 0.0, 0.0, 0.0]
    # A pole that leans has the cart accelerate, so that Y says something from the first step on.
    rows[:, task.STATE] = rows[:, task.INITIAL_STATE] = [0.0, 0.5, 0.0, 0.0]
    _, memory = policy.predict(rows)
    later = rows.copy()
    later[:, task.TIME] = 0.1
    later[:, task.STATE] = memory[0].plan.states[1]
    # The first row is where its plan is, the second is not.
    later[1, task.STATE] += np.array([0.0, 0.05, 0.3, 0.1], np.float32)
    _, memory = policy.predict(later, memory, np.zeros(2, bool))
    assert memory[0].estimate == pytest.approx(np.zeros(2), abs=1e-7)
    assert np.abs(memory[1].estimate).max() > 1e-5
    # A call that is not the next step, and a new episode, learn nothing.
    known = memory[1].estimate.copy()
    later[:, task.TIME] = 0.5
    _, memory = policy.predict(later, memory, np.zeros(2, bool))
    assert memory[1].estimate == pytest.approx(known)
    _, memory = policy.predict(rows, memory, np.ones(2, bool))
    assert np.all(memory[1].estimate == 0.0)
    # Without anything wrong it is tube MPC.
    other = TubeMpcPolicy(deadline=1e9)
    assert policy.predict(rows)[0] == pytest.approx(other.predict(rows)[0])


def test_the_sliding_policy_is_told_the_bound_and_brings_its_own() -> None:
    strong = SpacecraftVectorEnv(2, 2, "open", "uniform", 0.8, autoreset_mode="disabled")
    weak = SpacecraftVectorEnv(2, 2, "open", "uniform", 0.4, autoreset_mode="disabled")
    policies: Any = [lagros_policies.make(SLIDING, env) for env in (strong, weak)]
    margins = [policy.planner.settings.margins[0] for policy in policies]
    assert margins[0] == pytest.approx(2.0 * margins[1])
    assert lagros_policies.make(SLIDING, strong, disturbance_bound=0.4)
    bound = position_margin(policies[0], 0.8)
    assert bound == pytest.approx(steady_position_bound(SlidingAxis(3.0, 3.0, 0.1), 0.8))
    strong.reset(seed=[3])
    memory: Any = None
    largest = 0.0
    for step in range(strong.settings.steps):
        action, memory = policies[0].predict(strong.state(), memory)
        info = strong.step(action.reshape(2, -1))[4]
        away = strong.states[0, :, :2] - memory[0].nominal[step + 1, :, :2]
        largest = max(largest, float(np.linalg.norm(away, axis=-1).max()))
    assert info["success"].all()
    assert 0.1 * bound < largest < bound

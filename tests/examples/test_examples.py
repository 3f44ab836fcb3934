"""Every example trains at toy size: its weights change, and episodes come to their end."""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from lagros_policies.contraction import Basis, BoxRegion, CvStemSettings, design_metric
from lagros_policies.export import check as check_export
from tests import found

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def example(monkeypatch):
    """A function that loads an example, which is not part of a package, as a module."""
    return lambda name: load(name, monkeypatch)


def load(name, monkeypatch):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def weights(network):
    return np.concatenate([part.detach().numpy().ravel() for part in network.parameters()])


def check(before, after, returns, episodes):
    """Check that training changed weights and finished so many episodes."""
    assert before.shape == after.shape
    assert np.all(np.isfinite(after))
    # Adam moves every weight that has a gradient; a ReLU may leave some without one.
    assert np.mean(before != after) > 0.9
    assert len(returns) >= episodes
    assert np.all(np.isfinite(returns))


def test_every_example_is_tested_and_says_how_it_is_run():
    # Those that hold a task are walked with every other task.
    names = sorted(path.stem for path in EXAMPLES.glob("*.py") if path not in found.EXAMPLES)
    assert names == [
        "cleanrl_ppo_cartpole",
        "disturbed_pendulum",
        "metric_in_cvxpy",
        "planner_in_cvxpy",
        "rllib_ppo_spacecraft",
        "skrl_ppo_cartpole",
        "torchrl_ppo_spacecraft",
    ]
    guide = (EXAMPLES.parent / "docs" / "libraries.md").read_text()
    for name in names:
        assert f"python examples/{name}.py" in (EXAMPLES / f"{name}.py").read_text()
        assert f"examples/{name}.py" in guide


def test_the_metric_in_cvxpy_is_that_of_the_quick_program_and_proved(example, capsys):
    pytest.importorskip("cvxpy", reason="the extra `train` is not installed")
    module = example("metric_in_cvxpy")
    box = BoxRegion(
        (0.0, 0.0, -0.5, 1.0), (1.0, 1.0, 0.5, 2.0), (0.5,) * 4, (-1.0,) * 2, (1.0,) * 2
    )
    samples, place = box.sample(np.random.default_rng(1), 30), np.zeros((1, 4))
    program, _, nu, chi = module.cvstem(module.Car(), samples, Basis(("1",)), 0.2, 0.1, place)
    program.solve(solver="CLARABEL")
    quick = design_metric(module.Car(), samples, box, CvStemSettings(0.2, 0, 0.1, 0.0))
    assert quick.condition_bound == pytest.approx(float(chi.value), rel=1e-3)
    assert quick.control_weight == pytest.approx(float(nu.value), rel=1e-3)
    module.main()
    assert [line[:5] for line in capsys.readouterr().out.splitlines()] == ["yes: "] * 3


# What tests all over the project are skipped without; the extra `all` brings it.
WANTED = ("onnxruntime", "ray.rllib", "distributed", "minari", "pyarrow", "skrl", "torchrl")
INSTALLED = "CI" in os.environ or (Path(sys.prefix) / ".lagros-installed").exists()


@pytest.mark.skipif(not INSTALLED, reason="not installed by `make install`")
@pytest.mark.parametrize("module", WANTED)
def test_where_everything_was_installed_no_test_is_skipped_for_want_of_it(module):
    assert importlib.util.find_spec(module) is not None


@pytest.mark.skipif(not INSTALLED, reason="not installed by `make install`")
def test_where_everything_was_installed_exported_c_is_compiled():
    assert check_export.compiler() is not None


def test_cleanrl_style_ppo(example, capsys):
    pytest.importorskip("torch", reason="the extra `policies` is not installed")
    module = example("cleanrl_ppo_cartpole")
    toy = {"worlds": 4, "epochs": 2, "minibatches": 2}
    # An agent that balances nothing falls, and begins anew, several times in 90 steps.
    untrained, none = module.train(module.Settings(updates=0, **toy))
    trained, returns = module.train(module.Settings(updates=2, **toy))
    check(weights(untrained), weights(trained), returns, 8)
    assert none == []
    again, same = module.train(module.Settings(updates=2, **toy))
    np.testing.assert_array_equal(weights(again), weights(trained))
    assert same == returns


def test_its_advantage_is_the_sum_of_discounted_surprises(example):
    torch = pytest.importorskip("torch", reason="the extra `policies` is not installed")
    module = example("cleanrl_ppo_cartpole")

    class Worlds:
        """Two worlds with reward 1; the first ends at step 1, the second is cut off at step 2."""

        single_observation_space = single_action_space = np.zeros(1)
        step_count = 0

        def step(self, actions):
            count, self.step_count = self.step_count, self.step_count + 1
            terminated, truncated = np.array([count == 1, False]), np.array([False, count == 2])
            last = np.array([[0.0], [7.0]], np.float32)
            following = np.full((2, 1), float(count + 1), np.float32)
            return following, np.ones(2), terminated, truncated, {"final_obs": last}

    class Critic(module.Agent):
        def value(self, observation):
            return observation[..., 0]

    settings = module.Settings(worlds=2, steps=4, discount=0.5, trace=0.5)
    running, returns = np.zeros(2), []
    start = torch.zeros(2, 1)
    batch, _ = module._play(Worlds(), Critic(1, 1), start, settings, running, returns)
    advantage = batch[3].reshape(4, 2).numpy()
    assert returns == [2.0, 3.0]
    # V(o_k) = k. By hand, backwards, with delta_k = r + 0.5 V(o_k+1) - V(o_k):
    #   3: 1 + 2 - 3 = 0;  2: 1 + 1.5 - 2 = 0.5;  1: 1 + 1 - 1 = 1;  0: 1 + 0.5 - 0 = 1.5
    # The first world has no future at 1 (delta = 0), the second the value 7 at 2 (delta = 2.5).
    np.testing.assert_allclose(advantage[:, 0], [1.5 + 0.25 * 0.0, 0.0, 0.5 + 0.25 * 0.0, 0.0])
    np.testing.assert_allclose(
        advantage[:, 1], [1.5 + 0.25 * (1.0 + 0.25 * 2.5), 1.0 + 0.25 * 2.5, 2.5, 0.0]
    )


@pytest.mark.slow
def test_the_disturbed_pendulum(example):
    pytest.importorskip("stable_baselines3", reason="the extra `rl` is not installed")
    module = example("disturbed_pendulum")
    calm, pushed = (module.train(bound, steps=4096, seed=0) for bound in (0.0, module.BOUND))
    assert not np.array_equal(*(weights(model.policy) for model in (calm, pushed)))
    env = module.pendulum(module.BOUND)
    env.reset(seed=0)
    push = env.step(env.action_space.sample())[4]["disturbance"]
    assert np.linalg.norm(push) == pytest.approx(module.BOUND)


@pytest.mark.slow
def test_skrl(example):
    pytest.importorskip("skrl", reason="the extra `skrl` is not installed")
    module = example("skrl_ppo_cartpole")
    untrained, _ = module.train(updates=0, worlds=4)
    trained, returns = module.train(updates=2, worlds=4)
    check(weights(untrained), weights(trained), returns, 8)


@pytest.mark.slow
def test_torchrl(example, capsys):
    pytest.importorskip("torchrl", reason="the extra `torchrl` is not installed")
    module = example("torchrl_ppo_spacecraft")
    size = {"agents": 2, "cycles": 20, "steps": 60}
    untrained, _ = module.train(updates=0, **size)
    trained, returns = module.train(updates=2, **size)
    check(weights(untrained), weights(trained), returns, 6)
    assert len(returns) == 6


@pytest.mark.slow
def test_rllib(example, capsys):
    ray = pytest.importorskip("ray", reason="the extra `rllib` is not installed")
    pytest.importorskip("ray.rllib.algorithms.ppo", reason="the extra `rllib` is not installed")
    module = example("rllib_ppo_spacecraft")
    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False)
    try:
        (before, after), reports = module.train(updates=2, agents=2, cycles=20, steps=60)
    finally:
        ray.shutdown()
    flat = [
        np.concatenate([np.ravel(part) for part in state.values()]) for state in (before, after)
    ]
    episodes = [report["num_episodes_lifetime"] for report in reports]
    check(*flat, [reports[-1]["episode_return_mean"]], 1)
    assert episodes[-1] >= 4

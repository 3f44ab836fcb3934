"""What every policy has in common: names, protocol, batches, and what it needs not import."""

import sys

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

import lagros_envs  # noqa: F401  registers the environment
from lagros_envs.tasks.cartpole import task
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_policies import NAMES, Policy, make
from lagros_policies.lagros import LagrosPolicy
from lagros_policies.learned import LearnedPolicy
from lagros_policies.learning.features import seen
from lagros_policies.tasks.cartpole.features import CartPoleView
from lagros_policies.tasks.spacecraft import SPACECRAFT_NAMES
from lagros_policies.tube_mpc import TubeMpcPolicy

SHORT = CartPoleSettings(time_limit=3.0, goal_range=1.0)
OURS = ("learned", "tube-mpc", "lagros")


def cartpole_view(observation):
    features, side = seen(CartPoleView(), observation)
    return features, side[..., 0]


def make_env(**settings):
    return gym.make("lagros/CartPole-v0", disturbance="uniform", settings=SHORT, **settings)


@pytest.fixture
def env():
    env = make_env()
    yield env
    env.close()


@pytest.fixture
def build(env, metric, weights_file):
    """Build a policy by name from the small metric and weights."""

    def build(name, **settings):
        if name == "tube-mpc":
            settings.setdefault("metric", metric)
        elif name in ("lagros", "learned"):
            settings.setdefault("weights", weights_file)
            settings.setdefault("allow_other_settings", True)
        return make(name, env, **settings)

    return build


@pytest.fixture(scope="module")
def observations():
    """Return 6 observations of 6 episodes at 6 times, near where they began."""
    rng = np.random.default_rng(3)
    observation = np.zeros((6, 13), np.float32)
    observation[:, 9] = rng.uniform(-1.0, 1.0, 6)
    observation[:, :4] = observation[:, 8:12] + 0.05 * rng.standard_normal((6, 4))
    observation[:, 4] = rng.uniform(-1.0, 1.0, 6)
    observation[:, 12] = 0.1 * np.arange(6)
    return observation


@pytest.mark.parametrize("name", [*OURS, "lqr", "random"])
def test_policies_follow_the_protocol(build, env, name):
    policy = build(name)
    assert isinstance(policy, Policy)
    assert name in NAMES
    assert policy.name == name
    assert policy.observes in ("local", "global")
    observation, _ = env.reset(seed=1)
    action, state = policy.predict(observation, None, np.ones(1, bool), deterministic=True)
    assert action.shape == (1,)
    assert action.dtype == np.float32
    again, _ = policy.predict(observation, state, np.zeros(1, bool))
    assert np.all(np.isfinite(again))
    env.step(action)


def test_a_thing_without_the_members_is_no_policy():
    class Idle:
        def predict(self, observation):
            return observation

    assert not isinstance(Idle(), Policy)


@pytest.mark.parametrize(
    ("name", "hint"), [("lagross", "lagros"), ("tube_mpc", "tube-mpc"), ("LEARNED", "learned")]
)
def test_unknown_name_is_refused_with_a_hint_and_the_names(env, name, hint):
    with pytest.raises(ValueError, match=name) as caught:
        make(name, env)
    if hint is not None:
        assert f"Did you mean '{hint}'?" in str(caught.value)
    assert all(known in str(caught.value) for known in NAMES)


def test_a_package_that_is_missing_is_named(env, monkeypatch):
    monkeypatch.delitem(sys.modules, "lagros_policies.lagros")
    monkeypatch.setitem(sys.modules, "lagros_policies.learning.network_policy", None)
    with pytest.raises(ImportError, match=r"policy 'lagros' needs .*lagros\[policies\]"):
        make("lagros", env)


MISSING = """
import sys
missing = sys.argv[1]
sys.modules[missing] = None
import numpy as np
import lagros_policies
from lagros_envs import spacecraft_v0
from lagros_envs.tasks.cartpole.env import CartPoleEnv
from lagros_policies.tasks.spacecraft import SPACECRAFT_NAMES
failed = []
for names, env in (
    (lagros_policies.NAMES, CartPoleEnv()),
    (SPACECRAFT_NAMES, spacecraft_v0.parallel_env(1, "open")),
):
    for name in names:
        try:
            policy = lagros_policies.make(name, env)
        except ImportError as error:
            assert missing in str(error).lower() and "pip install 'lagros[" in str(error), error
            failed.append(name)
            continue
        # Who was built flies.
        seen, _ = env.reset(seed=0)
        if isinstance(seen, dict):
            seen = env.state() if policy.observes == "global" else seen["agent_0"]
        policy.predict(seen)
print(*failed)
"""


# Who plans, of one body and of many.
PLANNED = {
    name
    for name in (*NAMES, *SPACECRAFT_NAMES)
    if name.partition(":")[0] in ("tube-mpc", "lqr-plan", "sd-lqr", "mpc", "c3m", "centralized")
}


@pytest.mark.parametrize(
    ("package", "names"),
    [
        ("clarabel", PLANNED),
        ("piqp", PLANNED),
        ("scipy", {"lqr", *PLANNED}),
        (
            "safetensors",
            {"learned", "learned-mpc", "lagros", "c3m", "ppo", "sac", "td3", "residual"},
        ),
        ("torch", set()),
        ("cvxpy", set()),
        ("joblib", set()),
    ],
)
def test_a_missing_package_stops_who_needs_it_before_the_first_episode(run_python, package, names):
    assert set(run_python(MISSING, package).split()) == names


def test_environment_of_another_package_is_refused():
    other = gym.make("CartPole-v1")
    with pytest.raises(TypeError, match="CartPole"):
        make("lqr", other)
    other.close()


def test_path_that_does_not_exist_is_not_found(env, tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        make(str(tmp_path / "nowhere.zip"), env)
    for name in ("lagros", "learned"):
        with pytest.raises(FileNotFoundError, match="nowhere"):
            make(name, env, weights=tmp_path / "nowhere.safetensors")


@pytest.mark.parametrize("name", OURS)
def test_policy_takes_the_task_of_the_environment(build, env, name):
    assert build(name).settings == env.unwrapped.settings


@pytest.mark.parametrize("name", OURS)
def test_rows_of_a_batch_are_as_if_alone(build, observations, name):
    policy = build(name)
    batch, state = policy.predict(observations, None, np.ones(6, bool))
    assert batch.shape == (6, 1)
    assert batch.dtype == np.float32
    later = observations.copy()
    later[:, 12] += 0.1
    following, _ = policy.predict(later, state, np.zeros(6, bool))
    for row in range(6):
        alone, memory = policy.predict(observations[row])
        assert alone.shape == (1,)
        assert alone == pytest.approx(batch[row], rel=1e-5, abs=1e-5)
        then, _ = policy.predict(later[row], memory, np.zeros(1, bool))
        assert then == pytest.approx(following[row], rel=1e-5, abs=1e-5)
    assert np.ptp(batch) > 0.05


@pytest.mark.parametrize("name", OURS)
def test_action_is_not_overwritten_by_the_next_call(build, observations, name):
    policy = build(name)
    first, _ = policy.predict(observations[0])
    kept = first.copy()
    policy.predict(observations[1])
    assert np.array_equal(first, kept)


@pytest.mark.parametrize("name", OURS)
def test_observation_is_left_alone(build, observations, name):
    before = observations.copy()
    build(name).predict(observations)
    build(name).predict(observations[0])
    assert np.array_equal(observations, before)


@pytest.mark.parametrize("name", OURS)
def test_force_does_not_depend_on_the_unit_of_the_action(metric, weights_file, observations, name):
    forces = []
    for scale in (40.0, 8.0):
        settings = CartPoleSettings(time_limit=3.0, goal_range=1.0, force_scale=scale)
        if name == "tube-mpc":
            policy = TubeMpcPolicy(settings, metric)
        else:
            cls = LagrosPolicy if name == "lagros" else LearnedPolicy
            policy = cls(settings, weights_file, allow_other_settings=True)
        forces.append(scale * policy.predict(observations)[0])
    assert forces[0] == pytest.approx(forces[1], rel=1e-5)


@pytest.mark.parametrize("cls", [LagrosPolicy, LearnedPolicy])
def test_network_policy_is_its_network_on_the_features(cls, network, weights_file, observations):
    policy = cls(weights=weights_file)
    action, state = policy.predict(observations, "kept")
    features, side = cartpole_view(observations)
    assert action[:, 0] == pytest.approx(network(features)[:, 0] * side / 40.0, rel=1e-5)
    assert state == "kept"
    assert policy.bare_forward(features[0]) == pytest.approx(network(features[0]))
    assert policy.example_features().shape == (7,)
    assert policy.example_features().dtype == np.float32


@pytest.mark.parametrize("name", OURS)
def test_mirrored_episode_gets_the_opposite_force(build, observations, name):
    mirrored = observations * np.array([-1.0] * 12 + [1.0], np.float32)
    action, _ = build(name).predict(observations)
    opposite, _ = build(name).predict(mirrored)
    assert opposite == pytest.approx(-action, abs=1e-4 * float(np.abs(action).max()))


@pytest.mark.parametrize("name", OURS)
def test_stable_baselines3_evaluates_the_policy(build, name):
    reward, deviation = evaluate_policy(build(name), Monitor(make_env()), n_eval_episodes=2)
    assert np.isfinite(reward)
    assert deviation >= 0.0


def test_stable_baselines3_evaluates_a_planner_in_several_environments(build):
    # Rows start and end episodes at different times; every one keeps its own plan.
    policy = build("tube-mpc")
    envs = DummyVecEnv([lambda: Monitor(make_env(disturbance_bound=0.02)) for _ in range(3)])
    envs.seed(4)
    rewards, lengths = evaluate_policy(policy, envs, n_eval_episodes=4, return_episode_rewards=True)
    assert len(rewards) == 4
    assert lengths == [SHORT.steps] * 4
    envs.close()


BARE = """
import sys
import lagros_policies
heavy = {"torch", "cvxpy", "stable_baselines3", "scipy", "piqp", "clarabel", "pygame", "matplotlib"}
print(sorted(heavy & set(sys.modules)))
"""

PREDICT = """
import sys
import gymnasium as gym
import lagros_envs
import lagros_policies
env = gym.make("lagros/CartPole-v0", disturbance="uniform")
observation, _ = env.reset(seed=0)
settings = {"metric": sys.argv[2]} if sys.argv[1] == "tube-mpc" else {"weights": sys.argv[2]}
policy = lagros_policies.make(sys.argv[1], env, **settings)
state = None
for _ in range(3):
    action, state = policy.predict(observation, state)
    observation, *_ = env.step(action)
env.close()
print(sorted({"torch", "cvxpy", "stable_baselines3", "pygame", "matplotlib"} & set(sys.modules)))
"""


def test_importing_the_package_imports_no_solver_and_no_learner(run_python):
    assert run_python(BARE).strip() == "[]"


@pytest.mark.parametrize("name", OURS)
def test_predicting_imports_neither_torch_nor_cvxpy(
    run_python, metric, weights_file, tmp_path, name
):
    file = weights_file
    if name == "tube-mpc":
        from lagros_policies.contraction import save_metric

        file = tmp_path / "metric.json"
        save_metric(metric, file)
    assert run_python(PREDICT, name, file).strip() == "[]"


def test_observation_layout_is_that_of_the_task(observations):
    # The literals above are the documented layout.
    assert (slice(0, 4), slice(4, 8), slice(8, 12)) == (task.STATE, task.GOAL, task.INITIAL_STATE)
    assert task.TIME == 12
    assert observations.shape[1] == task.OBSERVATION_DIM


def test_make_builds_a_class_of_the_users_own(monkeypatch, tmp_path):
    (tmp_path / "own_policy_module.py").write_text(
        "class Still:\n"
        "    def __init__(self, settings):\n"
        "        self.unit = settings.force_scale\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    env = gym.make("lagros/CartPole-v0")
    assert make("own_policy_module:Still", env).unit == 40.0
    with pytest.raises(ValueError, match="no_such_module"):
        make("no_such_module:Still", env)
    with pytest.raises(ValueError, match="Moving"):
        make("own_policy_module:Moving", env)

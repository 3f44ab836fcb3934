"""The metric and the weights in the package, checked afresh on episodes they never saw.

A file that is not there yet is skipped, so that the package can be built from nothing.
"""

import json

import gymnasium as gym
import numpy as np
import pytest

import lagros_envs  # noqa: F401  registers the environment
import lagros_policies
from lagros_envs.seeding import EVALUATION, episode_seeds
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_policies.contraction import (
    certified_tube,
    contraction_residual,
    extreme_eigenvalues,
)
from lagros_policies.learning.dataset import ExpertDataSettings, generate
from lagros_policies.learning.features import seen
from lagros_policies.learning.networks import Mlp, read_safetensors
from lagros_policies.learning.replanned import generate_replanned
from lagros_policies.learning.train import learning_error
from lagros_policies.room import PRETRAINED
from lagros_policies.tasks.cartpole.expert import CartPoleExpert
from lagros_policies.tasks.cartpole.features import CartPoleView
from tests.policies.shipped import shipped_metric


def needs(*names):
    missing = [name for name in names if not (PRETRAINED / name).exists()]
    return pytest.mark.skipif(bool(missing), reason=f"not shipped yet: {missing}")


METRIC = "cartpole_metric.json"
POLICIES = ("lagros", "learned", "learned-mpc")


@pytest.fixture(scope="module")
def shipped():
    return shipped_metric()


def check_condition(oracle, metric, samples):
    """Check the matrix inequality of Theorem 2 itself, and its residual, at every sample."""
    state, nominal, control = samples.state, samples.nominal, samples.nominal_control
    h = 1e-5
    ahead, behind = (oracle.step(state, control, time, 1) for time in (h, -h))
    moving = (metric.dual(ahead) - metric.dual(behind)) / (2 * h)
    gain, dual = oracle.input_matrix(state), metric.dual(state)
    product = oracle.sdc(state, nominal, control, intervals=40) @ dual
    left = -moving + product + np.swapaxes(product, 1, 2) + 2 * metric.contraction_rate * dual
    left -= 2 * metric.control_weight * gain @ np.swapaxes(gain, 1, 2)
    assert np.linalg.eigvalsh(left)[:, -1].max() <= 1e-6
    scaled = dual * np.outer(metric.scaling, metric.scaling)
    values = np.linalg.eigvalsh(scaled)
    assert values.min() >= 1.0 - 1e-5
    assert values.max() <= metric.condition_bound * (1.0 + 1e-5)


@needs(METRIC)
def test_metric_carries_a_verification_that_found_nothing(shipped):
    check = shipped.verification
    assert check is not None
    assert check.samples >= 10_000
    assert check.violations == 0
    assert check.worst < 0.0


@needs(METRIC)
def test_condition_of_the_metric_holds_at_fresh_states(
    oracle, system, shipped, make_plans, make_samples
):
    samples = make_samples(shipped.region, make_plans(40, seed=2024), 2000, seed=1)
    check_condition(oracle, shipped, samples)
    assert contraction_residual(system, shipped, samples).max() <= 0.0


@pytest.mark.slow
@needs(METRIC)
def test_condition_of_the_metric_holds_at_10000_fresh_states(
    oracle, system, shipped, make_plans, make_samples
):
    samples = make_samples(shipped.region, make_plans(400, seed=2025), 10_000, seed=2)
    assert len(samples.state) == 10_000
    check_condition(oracle, shipped, samples)
    assert contraction_residual(system, shipped, samples).max() <= 0.0


@needs(METRIC)
def test_some_held_control_contracts_at_fresh_states(shipped, make_plans, make_samples):
    """The condition over the hold, which u* imposes, is not implied by the continuous one."""
    samples = make_samples(shipped.region, make_plans(40, seed=2026), 2000, seed=3)
    a, b, c = CartPoleExpert(shipped).law.quadratic(
        samples.state, samples.nominal, samples.nominal_control
    )
    assert np.all(a > 0.0)
    assert np.all(b * b >= a * c)


@needs(METRIC)
def test_starts_of_the_task_lie_in_the_region_of_the_metric(shipped, plans):
    states, controls = plans
    assert shipped.region.angle > np.pi / 3
    assert np.all(shipped.region.contains(states[:, :-1], states[:, :-1], controls))


def fly(policy, bound=0.75, kind="uniform", episodes=4, seed=7, **options):
    """Return the last info of each evaluation episode, and what the policy remembers."""
    env = gym.make("lagros/CartPole-v0", disturbance=kind, disturbance_bound=bound, **options)
    infos = []
    for episode in episode_seeds(seed, episodes, EVALUATION):
        observation, info = env.reset(seed=episode)
        memory, done = None, False
        while not done:
            action, memory = policy.predict(observation, memory, np.array([memory is None]))
            observation, _, terminated, truncated, info = env.step(action)
            done = terminated or truncated
        infos.append(info)
    env.close()
    return infos, memory


@needs(METRIC)
def test_certified_bound_of_the_shipped_metric_holds_under_the_worst_disturbance(
    oracle, shipped, plans
):
    bound = 0.05
    expert, tube = CartPoleExpert(shipped, law="tuned"), certified_tube(shipped, bound)
    env = gym.make(
        "lagros/CartPole-v0",
        disturbance="worst",
        disturbance_bound=bound,
        metric=shipped.matrix,
    )
    tracked = expert.track(*plans)
    rate, period = shipped.contraction_rate, oracle.period
    largest = np.sqrt(extreme_eigenvalues(shipped)[1])
    for plan in range(3):
        states = plans[0][plan]
        env.reset(seed=plan, options={"initial_state": states[0], "nominal": states})
        length = 0.0
        for step in range(90):
            state = env.unwrapped.state
            assert shipped.region.contains(state, states[step], plans[1][plan, step])
            control = expert.control(tracked, np.array([plan]), np.array([step]), state[None])[0]
            *_, info = env.step(control / 40.0)
            assert info["tracking_error"] <= tube.radius((step + 1) * period)
            # The length R of the proof, for a control that is held; see test_control.py.
            pushed = oracle.step(state, control, disturbance=info["disturbance"])
            drift = np.linalg.norm(pushed - oracle.step(state, control))
            length = np.exp(-rate * period) * length + largest * drift
            energy = oracle.energy(shipped, env.unwrapped.state, states[step + 1])
            assert np.sqrt(energy) <= 1.02 * length
    env.close()


@pytest.mark.parametrize("name", [pytest.param(n, marks=needs(METRIC)) for n in ("tube-mpc",)])
def test_planner_succeeds_under_the_disturbance_of_the_paper(name):
    env = gym.make("lagros/CartPole-v0")
    infos, memory = fly(policy := lagros_policies.make(name, env), episodes=2)
    assert all(info["success"] and info["inside_tube"] for info in infos)
    assert policy.counters(memory)["failed_plans"] == 0


@needs("cartpole_lagros.safetensors")
def test_lagros_succeeds_under_the_disturbance_of_the_paper():
    policy = lagros_policies.make("lagros", gym.make("lagros/CartPole-v0"))
    infos, _ = fly(policy, episodes=20)
    assert sum(info["success"] for info in infos) >= 20 - 1
    assert sum(info["inside_tube"] for info in infos) >= 20 - 1


@needs("cartpole_lagros.safetensors", "cartpole_learned.safetensors")
def test_learned_policy_falls_more_often_than_lagros():
    """The comparison of the paper's Table: without feedback of the error the pole falls."""
    fallen = {}
    for name in POLICIES:
        infos, _ = fly(lagros_policies.make(name, gym.make("lagros/CartPole-v0")), episodes=20)
        fallen[name] = sum(info["fallen"] for info in infos)
    assert fallen["learned"] > fallen["lagros"] + 3


@pytest.mark.parametrize(
    ("name", "ends", "scheduled"),
    [
        pytest.param("learned", (7, 1), 0, marks=needs("cartpole_learned.safetensors")),
        # Affine in the four numbers of the state: an offset and four gains come out.
        pytest.param("lagros", (3, 5), 4, marks=needs("cartpole_lagros.safetensors")),
    ],
)
def test_network_has_the_layers_of_the_paper(name, ends, scheduled):
    network = Mlp.load(PRETRAINED / f"cartpole_{name}.safetensors")
    assert [weight.shape for weight in network.weights] == [
        (ends[0], 100),
        (100, 100),
        (100, 100),
        (100, ends[1]),
    ]
    assert (network.inputs, network.outputs, network.scheduled) == (7, 1, scheduled)


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=needs(f"cartpole_{n}.safetensors")) for n in POLICIES]
)
def test_shipped_weights_carry_their_checksum(name):
    # Without it a flipped bit in a weight goes unnoticed. See read_safetensors.
    path = PRETRAINED / f"cartpole_{name}.safetensors"
    data = bytearray(path.read_bytes())
    assert b'"sha256"' in data[:2000]
    read_safetensors(path)


@pytest.fixture(scope="module")
def fresh(shipped, tmp_path_factory):
    """Return expert data of episodes that no training saw."""
    settings = ExpertDataSettings(plans=12, samples=1200, shards=2, seed=31_337)
    return generate(tmp_path_factory.mktemp("fresh"), shipped, settings)


def record(name):
    return json.loads((PRETRAINED / f"cartpole_{name}.json").read_text())


@needs(METRIC, "cartpole_lagros.safetensors", "cartpole_lagros.json")
def test_recorded_learning_error_of_lagros_is_that_of_fresh_episodes(fresh):
    network = Mlp.load(PRETRAINED / "cartpole_lagros.safetensors")
    features, side = seen(CartPoleView(), fresh.observation.astype(np.float32))
    labels = (fresh.control * side).astype(np.float32)
    error, stated = learning_error(network, features, labels), record("lagros")["learning_error"]
    assert error.mean < 2.0 * stated["mean"]
    assert error.mean > 0.3 * stated["mean"]
    assert error.mean < 0.05 * np.abs(labels).mean()


@needs(METRIC, "cartpole_learned.safetensors", "cartpole_learned.json")
def test_recorded_learning_error_of_the_learned_policy_is_that_of_fresh_episodes(fresh):
    network = Mlp.load(PRETRAINED / "cartpole_learned.safetensors")
    observation, control, _ = fresh.nominal_pairs(CartPoleSettings())
    features, side = seen(CartPoleView(), observation.astype(np.float32))
    labels = (control * side).astype(np.float32)
    error, stated = learning_error(network, features, labels), record("learned")["learning_error"]
    assert error.mean < 3.0 * stated["mean"]
    assert error.mean < 0.05 * np.abs(labels).mean()


@needs(METRIC, "cartpole_learned-mpc.safetensors", "cartpole_learned-mpc.json")
def test_recorded_learning_error_of_the_learned_mpc_is_that_of_fresh_episodes(shipped, tmp_path):
    network = Mlp.load(PRETRAINED / "cartpole_learned-mpc.safetensors")
    few = ExpertDataSettings(plans=40, samples=2000, shards=2, seed=31_337)
    # Where u* flies, and where the network comes to by itself.
    parts = [
        generate_replanned(tmp_path / name, shipped, few, network=flier)
        for name, flier in (("tube", None), ("own", network))
    ]
    observation = np.concatenate([part.observation for part in parts])
    features, side = seen(CartPoleView(), observation.astype(np.float32))
    labels = (np.concatenate([part.control for part in parts]) * side).astype(np.float32)
    error, stated = (
        learning_error(network, features, labels),
        record("learned-mpc")["learning_error"],
    )
    assert error.mean < 2.0 * stated["mean"]
    assert error.mean > 0.3 * stated["mean"]
    assert error.mean < 0.1 * np.abs(labels).mean()

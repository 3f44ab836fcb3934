"""The network of the spacecraft: symmetries, batches, files."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lagros_envs import spacecraft_v0
from lagros_envs.tasks.spacecraft.scenarios import PRESETS, Scenario
from lagros_envs.tasks.spacecraft.sensing import Layout
from lagros_policies.learning.deep_set import DeepSet, Elements, SetFeatures, pool
from lagros_policies.tasks.spacecraft.features import NEIGHBOUR, OBSTACLE, OWN
from lagros_policies.tasks.spacecraft.network_policy import SpacecraftNetworkPolicy
from lagros_policies.tasks.spacecraft.sensed import Sensed


def random_layers(rng: np.random.Generator, *widths: int):
    return [
        (rng.normal(size=(a, b)) / np.sqrt(a), 0.1 * rng.normal(size=b))
        for a, b in itertools.pairwise(widths)
    ]


def random_network(seed: int = 0) -> DeepSet:
    rng = np.random.default_rng(seed)
    return DeepSet(
        random_layers(rng, len(NEIGHBOUR), 16, 12),
        random_layers(rng, len(OBSTACLE), 16, 10),
        random_layers(rng, len(OWN) + 22, 20, 3),
    )


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    path = tmp_path / "net.safetensors"
    random_network().save(path)
    return path


@pytest.fixture
def scene():
    env = spacecraft_v0.parallel_env(num_agents=6, disturbance="uniform")
    env.reset(seed=3)
    for _ in range(20):  # so that there are velocities and spins
        actions = {agent: env.action_space(agent).sample() for agent in env.agents}
        observations, *_ = env.step(actions)
    return env, np.stack(list(observations.values()))


def test_no_thruster_pulls(weights, scene):
    env, rows = scene
    policy = SpacecraftNetworkPolicy(env.settings, env.preset, weights=weights)
    action, state = policy.predict(rows)
    assert action.shape == (6, 8)
    assert action.dtype == np.float32
    assert state is None
    assert np.all(action >= 0.0)
    assert np.any(action > 0.0)


def test_one_agent_is_its_row_of_the_batch(weights, scene):
    env, rows = scene
    policy = SpacecraftNetworkPolicy(env.settings, env.preset, weights=weights)
    together = policy.predict(rows)[0]
    alone = np.stack([policy.predict(row)[0] for row in rows])
    np.testing.assert_allclose(together, alone, rtol=1e-4, atol=1e-5)


def test_the_order_of_neighbours_and_obstacles_changes_no_action(weights, scene):
    env, rows = scene
    policy = SpacecraftNetworkPolicy(env.settings, env.preset, weights=weights)
    layout, rng = policy.layout, np.random.default_rng(0)
    shuffled = rows.copy()
    for kind, mask, size in (
        ("neighbours", "neighbour_mask", layout.neighbours),
        ("obstacles", "obstacle_mask", layout.obstacles),
    ):
        order = rng.permutation(size)
        part = rows[:, layout.slices[kind]].reshape(len(rows), size, -1)
        shuffled[:, layout.slices[kind]] = part[:, order].reshape(len(rows), -1)
        shuffled[:, layout.slices[mask]] = rows[:, layout.slices[mask]][:, order]
    assert not np.array_equal(shuffled, rows)
    np.testing.assert_allclose(
        policy.predict(shuffled)[0], policy.predict(rows)[0], rtol=1e-4, atol=1e-5
    )


def test_a_slot_that_is_not_sensed_does_not_count(weights, scene):
    env, rows = scene
    policy = SpacecraftNetworkPolicy(env.settings, env.preset, weights=weights)
    layout = policy.layout
    filled = rows.copy()
    slots = filled[:, layout.slices["neighbours"]].reshape(len(rows), layout.neighbours, -1)
    slots[filled[:, layout.slices["neighbour_mask"]] == 0.0] = 7.0
    filled[:, layout.slices["neighbours"]] = slots.reshape(len(rows), -1)
    assert not np.array_equal(filled, rows)
    np.testing.assert_array_equal(policy.predict(filled)[0], policy.predict(rows)[0])


def test_a_turned_world_gets_the_same_thrust(weights):
    # The body's axes turn against the world's as the heading grows (Spacecraft: T = R(phi)').
    env = spacecraft_v0.parallel_env(num_agents=6)
    env.reset(seed=5)
    old, angle = env.scenario, 0.7
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turned = Scenario(
        old.starts @ turn.T,
        old.headings - angle,
        old.goals @ turn.T,
        old.obstacles @ turn.T,
        old.obstacle_radii,
        old.agent_radius,
        old.core_radius,
    )
    policy = SpacecraftNetworkPolicy(env.settings, env.preset, weights=weights)
    thrusts = []
    for scenario in (old, turned):
        observations, _ = env.reset(seed=1, options={"scenario": scenario})
        thrusts.append(policy.predict(np.stack(list(observations.values())))[0])
    np.testing.assert_allclose(thrusts[1], thrusts[0], rtol=1e-3, atol=1e-4)


def test_what_appears_at_the_rim_of_sensing_appears_smoothly(weights):
    preset = replace(PRESETS["open"], agents=2)
    env = spacecraft_v0.parallel_env(preset=preset)
    policy = SpacecraftNetworkPolicy(env.settings, env.preset, weights=weights)
    actions = []
    for distance in (1.9999, 2.0001):
        scenario = Scenario(
            [[0.0, 0.0], [distance, 0.0]], [0.0, 0.0], [[3.0, 1.0], [0.0, 3.0]], [], []
        )
        observations, _ = env.reset(seed=0, options={"scenario": scenario})
        rows = np.stack(list(observations.values()))
        assert rows[0, policy.layout.slices["neighbour_mask"]].any() == (distance < 2.0)
        actions.append(policy.predict(rows)[0])
    np.testing.assert_allclose(actions[0], actions[1], atol=2e-3)


@pytest.mark.parametrize("agents", [1, 3, 12])
def test_the_same_weights_serve_any_number_of_agents(weights, agents):
    env = spacecraft_v0.parallel_env(num_agents=agents, preset="swarm")
    observations, _ = env.reset(seed=2)
    policy = SpacecraftNetworkPolicy(env.settings, env.preset, weights=weights)
    assert policy.predict(np.stack(list(observations.values())))[0].shape == (agents, 8)


def test_pooling_by_matrix_and_by_walk_agree(monkeypatch):
    rng = np.random.default_rng(1)
    owner = np.sort(rng.integers(0, 50, 200))
    values = rng.normal(size=(200, 7)).astype(np.float32)
    weight = rng.random(200, dtype=np.float32)
    expected = np.zeros((50, 7))
    for row, own, share in zip(values, owner, weight, strict=True):
        expected[own] += row * share
    for limit in (0, 10**9):
        monkeypatch.setattr("lagros_policies.learning.deep_set._DENSE", limit)
        sums = np.zeros((50, 7), np.float32)
        pool(values.copy(), owner, weight, sums)
        np.testing.assert_allclose(sums, expected, atol=1e-5)


def test_a_file_gives_the_network_back(weights):
    network, again = random_network(), DeepSet.load(weights)
    for name, layers in network.layers.items():
        for ours, theirs in zip(layers, again.layers[name], strict=True):
            np.testing.assert_array_equal(ours[0], theirs[0])
            np.testing.assert_array_equal(ours[1], theirs[1])
    assert again.weights == network.weights


def test_damaged_and_foreign_files_are_refused(weights, tmp_path):
    data = bytearray(weights.read_bytes())
    data[-3] ^= 0xFF
    bad = tmp_path / "bad.safetensors"
    bad.write_bytes(bytes(data))
    with pytest.raises(ValueError, match="damaged"):
        DeepSet.load(bad)
    with pytest.raises(FileNotFoundError):
        DeepSet.load(tmp_path / "none.safetensors")
    from lagros_policies.room import PRETRAINED

    with pytest.raises(ValueError, match="not a deep set"):
        DeepSet.load(PRETRAINED / "cartpole_lagros.safetensors")


def test_layers_that_do_not_chain_are_refused():
    rng = np.random.default_rng(0)
    good = random_layers(rng, len(NEIGHBOUR), 5), random_layers(rng, len(OBSTACLE), 4)
    with pytest.raises(ValueError, match="agent knows nothing"):
        DeepSet(*good, random_layers(rng, 9, 3))
    with pytest.raises(ValueError, match="layer 1 of agent"):
        DeepSet(*good, [*random_layers(rng, 19, 4), *random_layers(rng, 5, 2)])
    with pytest.raises(ValueError, match="not finite"):
        DeepSet(*good, [(np.full((len(OWN) + 9, 3), np.nan), np.zeros(3))])


def test_observations_of_another_size_are_refused(weights):
    policy = SpacecraftNetworkPolicy(num_agents=6, weights=weights)
    with pytest.raises(ValueError, match="build the policy with"):
        policy.predict(np.zeros((2, 10), np.float32))


def test_the_parts_of_an_observation_are_what_the_layout_says(scene):
    env, rows = scene
    sensed = Sensed.of(Layout.for_preset(env.preset, env.settings), rows)
    states, scenario = env.states, env.scenario
    np.testing.assert_allclose(sensed.goal, scenario.goals - states[:, :2], atol=1e-5)
    np.testing.assert_allclose(np.cos(sensed.heading), np.cos(states[:, 2]), atol=1e-6)
    np.testing.assert_allclose(np.sin(sensed.heading), np.sin(states[:, 2]), atol=1e-6)
    np.testing.assert_allclose(sensed.spin, states[:, 5], atol=1e-6)
    apart = np.linalg.norm(states[:, None, :2] - states[None, :, :2], axis=-1)
    np.testing.assert_array_equal(sensed.neighbour_mask.sum(1), (apart <= 2.0).sum(1) - 1)


def test_to_be_late_is_to_have_left_later(weights, scene):
    env, rows = scene
    policy = SpacecraftNetworkPolicy(env.settings, env.preset, weights=weights)
    goal, time = policy.layout.slices["goal"], policy.layout.slices["time"]
    far, near = np.tile(rows[:1], (3, 1)), np.tile(rows[:1], (2, 1))
    # 3 m at 0.3 m/s are 10 s, whatever the clock says from 20 s on; the horizon is 30 s.
    far[:, goal], far[:, time] = (3.0, 0.0), [[10.0], [20.0], [44.0]]
    early, on_time, late = policy.predict(far)[0]
    # A matrix product may round the rows of a batch differently.
    np.testing.assert_allclose(late, on_time, rtol=0.0, atol=1e-5)
    assert not np.allclose(early, on_time, rtol=0.0, atol=1e-2)
    near[:, goal], near[:, time] = (0.1, 0.0), [[28.0], [44.0]]
    np.testing.assert_allclose(*policy.predict(near)[0], rtol=0.0, atol=1e-5)


@pytest.mark.parametrize(("own", "outputs"), [(len(OWN) - 1, 3), (len(OWN), 2)])
def test_a_network_of_other_features_or_answers_is_refused(tmp_path, own, outputs):
    rng = np.random.default_rng(0)
    parts = random_layers(rng, len(NEIGHBOUR), 5), random_layers(rng, len(OBSTACLE), 4)
    network = DeepSet(*parts, random_layers(rng, own + 9, outputs))
    assert (network.inputs, network.outputs) == ((own, 7, 8), outputs)
    path = tmp_path / "other.safetensors"
    network.save(path)
    text = rf"other\.safetensors maps .* to {outputs}; .*lagros reproduce"
    with pytest.raises(ValueError, match=text):
        SpacecraftNetworkPolicy(weights=path)


def test_a_set_of_any_features_is_the_sum_over_its_elements():
    rng = np.random.default_rng(4)
    parts = (3, 6, 5), (2, 4), (2 + 5 + 4, 7, 6)
    network = DeepSet(*(random_layers(rng, *widths) for widths in parts))
    assert (network.inputs, network.outputs) == ((2, 3, 2), 6)
    own = rng.normal(size=(3, 2)).astype(np.float32)
    owners = np.array([0, 0, 2]), np.array([1])
    elements = [
        Elements(
            rng.normal(size=(len(owner), width)).astype(np.float32),
            owner,
            rng.random(len(owner), dtype=np.float32),
        )
        for owner, width in zip(owners, (3, 2), strict=True)
    ]
    answers = network(SetFeatures(own, *elements, np.ones(3, complex)))

    def through(layers, value, last=False):
        for index, (weight, bias) in enumerate(layers):
            value = value @ weight + bias
            value = value if last and index == len(layers) - 1 else np.maximum(value, 0.0)
        return value

    for agent in range(3):
        inputs = [own[agent]]
        for name, width, of_kind in zip(("neighbour", "obstacle"), (5, 4), elements, strict=True):
            total = np.zeros(width)
            for value, owner, weight in zip(*of_kind, strict=True):
                total += weight * through(network.layers[name], value) * (owner == agent)
            inputs.append(total)
        wanted = through(network.layers["agent"], np.concatenate(inputs), last=True)
        np.testing.assert_allclose(answers[agent], wanted, rtol=1e-5, atol=1e-6)

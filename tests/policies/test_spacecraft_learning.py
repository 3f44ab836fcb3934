"""Expert flights and the training on them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lagros_envs.seeding import EVALUATION, episode_seeds, episode_streams
from lagros_envs.tasks.spacecraft.scenarios import Scenario, preset_named
from lagros_envs.tasks.spacecraft.sensing import Layout
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_policies.learning import train_deep_set
from lagros_policies.learning.train_deep_set import (
    DeepSetTraining,
    SetSamples,
    fit_deep_set,
    join,
)
from lagros_policies.tasks.spacecraft.expert import SpacecraftExpert, SpacecraftExpertSettings
from lagros_policies.tasks.spacecraft.features import spacecraft_features
from lagros_policies.tasks.spacecraft.flights import (
    FlightSettings,
    flight_samples,
    fly_expert,
    make_shard,
    resize,
)
from lagros_policies.tasks.spacecraft.pace import CRUISE_SPEED
from lagros_policies.tasks.spacecraft.sensed import Sensed

TASK = SpacecraftSettings()
SMALL = FlightSettings(worlds=2, worlds_per_shard=1, agents=(2,), sample_every=50, seed=3)


@pytest.fixture(scope="module")
def flights(tmp_path_factory):
    return fly_expert(tmp_path_factory.mktemp("flights"), SMALL, TASK)


def test_flights_are_resumed_and_do_not_depend_on_processes(flights, tmp_path):
    first = fly_expert(tmp_path, SMALL, TASK, jobs=2)
    (tmp_path / "shard_0001.npz").unlink()
    again = fly_expert(tmp_path, SMALL, TASK)
    for data in (first, again):
        np.testing.assert_array_equal(data.observation, flights.observation)
        np.testing.assert_array_equal(data.acceleration, flights.acceleration)
    with pytest.raises(ValueError, match="other settings"):
        fly_expert(tmp_path, replace(SMALL, seed=4), TASK)


def test_no_training_world_is_an_evaluation_world():
    training = set(episode_seeds(SMALL.seed, 100))
    assert not training & set(episode_seeds(SMALL.seed, 100, EVALUATION))


def test_without_disturbance_the_labels_are_the_plan(tmp_path):
    calm = replace(SMALL, worlds=1, disturbance_bound=0.0, sample_every=1)
    shard = make_shard(0, calm, TASK, None)
    # u_d is held over node steps of 0.5 s and ends at rest: per axis it adds up to zero.
    labels = shard["acceleration"].reshape(TASK.steps, 2, 3)
    held = labels[:300].reshape(60, 5, 2, 3)
    # u* closes what float32 and rounding open, no more.
    np.testing.assert_allclose(held, held[:, :1].repeat(5, 1), atol=1e-3)
    np.testing.assert_allclose(labels[:300].sum(0), 0.0, atol=1e-2)
    np.testing.assert_allclose(labels[300:], 0.0, atol=1e-3)
    assert np.all(shard["success"])


@pytest.fixture(scope="module")
def world():
    preset = preset_named("paper").for_agents(3)
    return preset.sample(episode_streams(11).scenario)


def test_a_new_plan_may_begin_beside_the_states_but_not_in_touch(world):
    expert = SpacecraftExpert([world], SpacecraftExpertSettings(), TASK)
    states = np.zeros((3, 6))
    states[:, :2], states[:, 2] = world.starts, world.headings
    # Two agents overlap, at speed.
    states[1, :2] = states[0, :2] + (0.3, 0.0)
    states[:, 3] = 0.2
    assert expert.plan(0, 50, states)
    begin = expert.nominal[0, 50]
    assert np.linalg.norm(begin[0, :2] - begin[1, :2]) >= 2 * world.agent_radius
    # Who has room stays where it is, nearly.
    assert np.linalg.norm(begin[2, :2] - states[2, :2]) < 0.1
    label = expert.acceleration(50, states[None])[0]
    assert label[0, 0] < 0.0 < label[1, 0]  # u* pushes them apart


@pytest.mark.parametrize("step", [0, 50])
@pytest.mark.parametrize(("preference", "side"), [(0.01, 1.0), (0.25, -1.0)])
def test_every_plan_passes_counter_clockwise_where_both_sides_are_alike(step, preference, side):
    # Above is a little shorter, and clockwise.
    scenario = Scenario([[0.0, 0.0]], [0.0], [[4.0, 0.0]], [[2.0, -0.1]], [0.5])
    settings = SpacecraftExpertSettings(side_preference=preference)
    expert = SpacecraftExpert([scenario], settings, TASK)
    assert expert.plan(0, step, np.zeros((1, 6)))
    height = expert.nominal[0, step:, 0, 1]
    assert side * height[np.argmax(np.abs(height))] > 0.3


def test_who_is_late_does_not_rush(world):
    expert = SpacecraftExpert([world], SpacecraftExpertSettings(), TASK)
    states = np.zeros((3, 6))
    states[:, :2], states[:, 2] = world.starts, world.headings
    assert expert.plan(0, 290, states)  # a second before the horizon, at the start
    speed = np.linalg.norm(expert.nominal[0, 290:, :, 3:5], axis=-1)
    assert speed.max() < 0.7
    # Nobody is at rest at the goal by the horizon, and everybody is by the time that it takes.
    way = np.linalg.norm(world.goals - world.starts, axis=1)
    for agent in range(3):
        arrival = 290 + round(way[agent] / CRUISE_SPEED / 0.1) + 10
        if arrival <= TASK.steps:
            np.testing.assert_allclose(
                expert.nominal[0, arrival, agent, :2], world.goals[agent], atol=1e-6
            )


def test_resizing_keeps_what_is_sensed():
    small, large = Layout(2, 3, 45.0), Layout(5, 6, 45.0)
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(4, small.size)).astype(np.float32)
    rows[:, small.slices["neighbour_mask"]] = 1.0
    rows[:, small.slices["obstacle_mask"]] = [1.0, 0.0, 1.0]
    before, after = Sensed.of(small, rows), Sensed.of(large, resize(rows, small, large))
    np.testing.assert_array_equal(after.goal, before.goal)
    np.testing.assert_array_equal(after.neighbours[:, :2], before.neighbours)
    np.testing.assert_array_equal(after.obstacle_mask[:, :3], before.obstacle_mask)
    assert not after.neighbour_mask[:, 2:].any()
    assert not after.obstacle_mask[:, 3:].any()


def random_samples(count: int, seed: int) -> SetSamples:
    """Return samples whose label is a sum over neighbours, which only a deep set can learn."""
    layout = Layout(4, 3, 45.0)
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(count, layout.size)).astype(np.float32)
    for mask in ("neighbour_mask", "obstacle_mask"):
        rows[:, layout.slices[mask]] = rng.random((count, 1)) < 0.5
    features = spacecraft_features(Sensed.of(layout, rows), TASK, 0.25, 0.25)
    target = np.zeros((count, 3), np.float32)
    np.add.at(target[:, 0], features.neighbours.owner, features.neighbours.values[:, 3])
    target[:, 1:] = rng.normal(size=(count, 2)) * 0.1
    return SetSamples(features, target, np.arange(count))


def test_the_fit_learns_a_sum_over_neighbours(tmp_path):
    training = DeepSetTraining((16,), (16,), epochs=20, batch=64, learning_rate=5e-3)
    network = fit_deep_set(random_samples(2000, 0), training, tmp_path / "c")
    fresh = random_samples(500, 1)
    error = network(fresh.features)[:, 0] - fresh.target[:, 0]
    assert np.mean(error**2) < 0.1 * np.var(fresh.target[:, 0])


def test_an_interrupted_fit_gives_the_same_network(tmp_path):
    samples = random_samples(300, 2)
    training = DeepSetTraining((8,), (8,), epochs=4, batch=64)
    whole = fit_deep_set(samples, training, tmp_path / "whole")

    class StoppedError(Exception):
        pass

    def stop(epoch: int, loss: float) -> None:
        if epoch == 2:
            raise StoppedError

    with pytest.raises(StoppedError):
        fit_deep_set(samples, training, tmp_path / "part", stop)
    resumed = fit_deep_set(samples, training, tmp_path / "part")
    for name, layers in whole.layers.items():
        for ours, theirs in zip(layers, resumed.layers[name], strict=True):
            np.testing.assert_array_equal(ours[0], theirs[0])
    with pytest.raises(ValueError, match="other settings or data"):
        fit_deep_set(random_samples(300, 3), training, tmp_path / "part")


def test_the_network_without_torch_is_the_one_that_was_trained(tmp_path):
    samples = random_samples(200, 4)
    run = train_deep_set._Run(samples, DeepSetTraining((8, 6), (7,), epochs=1), tmp_path / "c")
    run.one_epoch()
    trained = run._forward(np.arange(200)).detach().numpy() * run.target_scale
    np.testing.assert_allclose(run.network()(samples.features), trained, rtol=1e-3, atol=1e-4)


def test_joined_samples_keep_their_elements_and_worlds(flights):
    one = flight_samples(flights, TASK, 0.25, 0.25)
    both = join([one, one])
    count, elements = len(one), len(one.features.neighbours.owner)
    assert len(both) == 2 * count
    np.testing.assert_array_equal(
        both.features.neighbours.owner[elements:], one.features.neighbours.owner + count
    )
    assert set(both.world[:count]).isdisjoint(both.world[count:])


def test_labels_turn_with_the_frame_of_the_goal(flights):
    samples = flight_samples(flights, TASK, 0.25, 0.25)
    back = (samples.target[:, 0] + 1j * samples.target[:, 1]) * samples.features.frame
    np.testing.assert_allclose(back.real, flights.acceleration[:, 0], atol=1e-5)
    np.testing.assert_allclose(back.imag, flights.acceleration[:, 1], atol=1e-5)


def test_a_learner_can_fly_and_is_labelled(tmp_path):
    network = fit_deep_set(random_samples(200, 5), DeepSetTraining((8,), (8,), 1), tmp_path / "c")
    weights: Path = tmp_path / "net.safetensors"
    network.save(weights)
    settings = replace(SMALL, worlds=1, replan_period=5.0, sample_after=(0, 2))
    data = fly_expert(tmp_path / "flights", settings, TASK, weights)
    # Plans at 0, 5, ... 40 s; two samples of two agents after each but the first.
    assert data.plans == 9
    assert len(data.observation) == (8 - data.failed_plans) * 2 * 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"worlds": 3, "worlds_per_shard": 2}, "must divide"),
        ({"agents": ()}, "agents"),
        ({"open_share": 1.5}, "open_share"),
        ({"replan_period": 0.0}, "replan_period"),
    ],
)
def test_flight_settings_are_checked(change, message):
    with pytest.raises(ValueError, match=message):
        FlightSettings(**change)


def test_expert_and_training_settings_are_checked():
    with pytest.raises(ValueError, match="margin"):
        SpacecraftExpertSettings(margin=0.0)
    with pytest.raises(ValueError, match="element"):
        DeepSetTraining(element=())


def test_an_input_that_never_varied_does_not_count(tmp_path):
    samples = random_samples(300, 6)
    samples.features.obstacles.values[:, 7] = 0.75  # bodies of one size, say
    network = fit_deep_set(samples, DeepSetTraining((8,), (8,), 1), tmp_path / "c")
    before = network(samples.features)
    samples.features.obstacles.values[:, 7] = 0.5
    np.testing.assert_allclose(network(samples.features), before, atol=1e-6)
    samples.features.obstacles.values[:, 2] += 0.5  # an input that did vary does count
    assert np.abs(network(samples.features) - before).max() > 1e-3

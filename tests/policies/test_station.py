"""How (c) learns to keep station: labels at the goal, and a fit that goes on from given weights."""

import numpy as np
import pytest

from lagros_envs.tasks.spacecraft.sensing import Layout
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_policies.contraction.axis_gain import AxisGain
from lagros_policies.learning.deep_set import DeepSet
from lagros_policies.learning.train_deep_set import DeepSetTraining, fit_deep_set
from lagros_policies.room import PRETRAINED
from lagros_policies.tasks.spacecraft.flights import FlightSettings, flight_samples
from lagros_policies.tasks.spacecraft.network_policy import SpacecraftNetworkPolicy
from lagros_policies.tasks.spacecraft.sensed import Sensed
from lagros_policies.tasks.spacecraft.station import StationSettings, fly_station

TASK = SpacecraftSettings()
SHIPPED = PRETRAINED / "spacecraft_lagros.safetensors"
SMALL = StationSettings(
    flights=FlightSettings(worlds=2, worlds_per_shard=1, agents=(2,), sample_every=9, seed=5),
    rate=4.0,
)


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    return fly_station(tmp_path_factory.mktemp("station"), SMALL, TASK, SHIPPED)


def rows(goals, neighbour=None):
    """Return what agents sense that are so far from their goals."""
    layout = Layout(1, 1, TASK.time_limit)
    observation = np.zeros((len(goals), layout.size), np.float32)
    at = layout.slices
    observation[:, at["goal"]] = goals
    observation[:, at["heading"]] = (1.0, 0.0, 0.0)
    if neighbour is not None:
        observation[:, at["neighbours"]] = (*neighbour, 0.0, 0.0)
        observation[:, at["neighbour_mask"]] = 1.0
    return Sensed.of(layout, observation)


def test_the_gain_is_the_label_at_the_goal_and_the_network_elsewhere():
    settings = StationSettings(inner=0.2, outer=0.4)
    goals = [(0.1, 0.0), (0.2, 0.0), (0.0, 0.3), (0.4, 0.0), (2.0, 1.0)]
    assert settings.share(rows(goals), 0.25) == pytest.approx([1.0, 1.0, 0.5, 0.0, 0.0], abs=1e-6)
    # Who has another body near minds that.
    assert not settings.share(rows(goals, (0.7, 0.0)), 0.25).any()
    assert settings.share(rows(goals, (0.9, 0.0)), 0.25).any()


def test_labels_at_the_goal_are_those_of_the_gain(flown):
    sensed = Sensed.of(flown.layout, flown.observation)
    share = SMALL.share(sensed, 0.25)
    assert (share == 1.0).sum() > 20
    assert (share == 0.0).sum() > 20
    gain = AxisGain.of_rate(SMALL.rate)
    expected = gain.deviation(-sensed.goal, sensed.velocity)
    label = flown.acceleration[:, :2]
    assert label[share == 1.0] == pytest.approx(expected[share == 1.0], abs=1e-4)
    policy = SpacecraftNetworkPolicy(TASK, "paper", 2, weights=SHIPPED)
    assert policy.layout.size == flown.layout.size
    features = policy.features(sensed)
    own = policy.network(features)
    plane = (own[:, 0] + 1j * own[:, 1]) * features.frame
    away = share == 0.0
    assert label[away, 0] == pytest.approx(plane.real[away], abs=1e-4)
    assert label[away, 1] == pytest.approx(plane.imag[away], abs=1e-4)
    assert flown.acceleration[:, 2] == pytest.approx(own[:, 2], abs=1e-4)


def test_a_fit_that_goes_on_begins_where_the_network_is(flown, tmp_path):
    samples = flight_samples(flown, TASK, 0.25, 0.25)
    begun = DeepSet.load(SHIPPED)
    # A step of no size leaves the network as it was.
    still = DeepSetTraining(epochs=1, learning_rate=1e-12)
    same = fit_deep_set(samples, still, tmp_path / "same", begun=begun)
    assert same(samples.features) == pytest.approx(begun(samples.features), abs=1e-4)
    moved = fit_deep_set(
        samples, DeepSetTraining(epochs=20, learning_rate=1e-3), tmp_path / "moved", begun=begun
    )
    before, after = (
        np.mean(np.abs(network(samples.features) - samples.target)) for network in (begun, moved)
    )
    assert after < before
    with pytest.raises(ValueError, match="other widths"):
        fit_deep_set(samples, DeepSetTraining((8,), (8,)), tmp_path / "other", begun=begun)


def test_settings_out_of_range_are_refused():
    with pytest.raises(ValueError, match="outer"):
        StationSettings(inner=0.3, outer=0.2)
    with pytest.raises(ValueError, match="rate"):
        StationSettings(rate=0.0)

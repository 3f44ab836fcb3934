"""The guide of crowds against brute force and in flight; flights of crowds; samples by choice."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lagros_envs.tasks.spacecraft.scenarios import preset_named
from lagros_envs.tasks.spacecraft.sensing import Layout
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings, settings_for
from lagros_policies.learning.deep_set import DeepSet
from lagros_policies.learning.train_deep_set import join, only
from lagros_policies.room import PRETRAINED
from lagros_policies.tasks.spacecraft.crowds import CrowdSettings, fly_crowd
from lagros_policies.tasks.spacecraft.features import NEIGHBOUR, OWN
from lagros_policies.tasks.spacecraft.flights import FlightSettings
from lagros_policies.tasks.spacecraft.guide import Guide
from lagros_policies.tasks.spacecraft.sensed import Sensed

SHIPPED = PRETRAINED / "spacecraft_lagros.safetensors"


def nearest_approach(apart, velocity, look):
    """Least distance to the body over the look-ahead at a constant relative velocity."""
    times = np.linspace(0.0, look, 2001)
    return np.min(np.abs(apart - times * velocity))


def test_the_change_is_the_least_that_meets_nothing():
    rng = np.random.default_rng(0)
    guide = Guide()
    sizes = {"inside": 0, "outside": 0}
    for _ in range(300):
        room = rng.uniform(0.3, 1.0)
        apart = rng.uniform(room * 1.01, 2.5) * np.exp(1j * rng.uniform(-np.pi, np.pi))
        velocity = rng.uniform(0.0, 1.2) * np.exp(1j * (np.angle(apart) + rng.normal(0.0, 0.7)))
        change, normal = (
            part[0, 0]
            for part in guide._changes(*(np.array([[x]]) for x in (apart, velocity, room)))
        )
        assert abs(abs(normal) - 1.0) < 1e-9
        # It leads to the rim of what is forbidden.
        least = nearest_approach(apart, velocity + change, guide.look)
        assert least == pytest.approx(room, abs=2e-3)
        meets = nearest_approach(apart, velocity, guide.look) < room - 1e-3
        sizes["inside" if meets else "outside"] += 1
        # Out of it along the normal, or back to it; and nothing shorter gets there.
        assert (change * normal.conj()).real == pytest.approx(
            abs(change) if meets else -abs(change), abs=1e-3
        )
        shorter = 0.98 * abs(change) * np.exp(1j * np.linspace(-np.pi, np.pi, 60))
        reached = [nearest_approach(apart, velocity + one, guide.look) for one in shorter]
        if meets:
            assert max(reached) < room + 1e-3
    assert min(sizes.values()) > 30


def sensed(goal, velocity, neighbours=(), obstacles=()):
    layout = Layout(4, 3, 45.0)
    row = np.zeros(layout.size)
    row[layout.slices["goal"]], row[layout.slices["velocity"]] = goal, velocity
    row[layout.slices["heading"]] = 1.0, 0.0, 0.0
    for name, bodies, width in (("neighbour", neighbours, 4), ("obstacle", obstacles, 3)):
        for index, body in enumerate(bodies):
            begin = layout.slices[f"{name}s"].start + index * width
            row[begin : begin + width] = body
            row[layout.slices[f"{name}_mask"].start + index] = 1.0
    return Sensed.of(layout, row)


def asked(*scene, pace=0.4):
    return complex(Guide().acceleration(sensed(*scene), pace, 0.25, 0.25)[0])


def test_alone_it_keeps_the_speed_of_its_pace_and_stops_at_the_goal():
    far = asked([3.0, 0.0], [0.0, 0.0])
    assert far == pytest.approx(Guide().gain * 0.6)
    assert asked([3.0, 0.0], [0.6, 0.0]) == pytest.approx(0.0)
    assert asked([0.0, 0.0], [0.0, 0.0]) == pytest.approx(0.0)
    place, speed = 3.0, 0.0
    for _ in range(400):
        acceleration = asked([place, 0.0], [speed, 0.0]).real
        place -= 0.1 * speed + 0.005 * acceleration
        speed += 0.1 * acceleration
        assert place > -0.1
    assert abs(place) < 0.02


def test_head_on_both_lean_to_their_right_and_an_obstacle_is_left_to_one():
    goal, velocity = [4.0, 0.0], [0.5, 0.0]
    met = asked(goal, velocity, [[1.5, 0.0, -1.0, 0.0]])
    assert met.imag < -0.02
    # The other sees the same turned by half a turn, and does the same there.
    other = asked([-4.0, 0.0], [-0.5, 0.0], [[-1.5, 0.0, 1.0, 0.0]])
    assert other == pytest.approx(-met, abs=1e-9)
    blocked = asked(goal, velocity, (), [[1.1, 0.05, 0.5]])
    assert blocked.real < met.real


def test_crowds_whose_t_differs_are_flown_apart():
    many = replace(SMALL, preset="swarm", agents=(12, 32))
    with pytest.raises(ValueError, match=r"agents=\(12, 32\).*swarm.*one by one"):
        CrowdSettings(many)
    assert CrowdSettings(replace(many, preset="swarm-45")).flights.agents == (12, 32)


SMALL = FlightSettings(worlds=4, worlds_per_shard=2, agents=(3,), sample_every=20, seed=9)


@pytest.fixture(scope="module", params=["swarm-45", "gcbf"])
def crowd(request, tmp_path_factory):
    settings = CrowdSettings(replace(SMALL, preset=request.param), fastest=0.4)
    folder = tmp_path_factory.mktemp(request.param)
    return settings, folder, fly_crowd(folder / "guided", settings, SHIPPED, True)


def test_flights_of_crowds_give_what_was_asked_for(crowd):
    settings, folder, samples = crowd
    steps = settings_for(preset_named(settings.flights.preset).for_agents(3)).steps
    assert len(samples) == 4 * 3 * -(-steps // 20)
    assert np.isfinite(samples.target).all()
    assert samples.features.own[:, 0].max() <= 2.0 + 1e-5
    np.testing.assert_allclose(
        samples.features.own[:, OWN.index("time to go [s]")],
        np.maximum(samples.features.own[:, 0] / 0.4, 2.0),
        rtol=1e-5,
    )
    # Kept shards are not flown again, and the network meets other states than the guide.
    again = fly_crowd(folder / "guided", settings, SHIPPED, True)
    np.testing.assert_array_equal(again.target, samples.target)
    met = fly_crowd(folder / "met", settings, SHIPPED, False)
    assert len(met) == len(samples)
    assert np.mean(np.abs(met.features.own - samples.features.own)) > 0.01
    with pytest.raises(ValueError, match="other settings"):
        fly_crowd(folder / "met", replace(settings, pace=0.3), SHIPPED, False)


def test_chosen_samples_are_those_samples(crowd):
    _, _, samples = crowd
    network = DeepSet.load(SHIPPED)
    answers = network(samples.features)
    chosen = np.random.default_rng(0).random(len(samples)) < 0.4
    part = only(samples, chosen)
    np.testing.assert_allclose(network(part.features), answers[chosen], rtol=1e-4, atol=1e-5)
    both = join([part, only(samples, ~chosen)])
    order = np.concatenate([np.flatnonzero(chosen), np.flatnonzero(~chosen)])
    np.testing.assert_allclose(network(both.features), answers[order], rtol=1e-4, atol=1e-5)
    assert samples.features.neighbours.values.shape[1] == len(NEIGHBOUR)


@pytest.mark.parametrize("wrong", [{"gain": 0.0}, {"pair_margin": -0.1}, {"bodies": 0}])
def test_a_guide_that_cannot_be_is_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Guide(**wrong)
    assert isinstance(SHIPPED, Path)
    assert SpacecraftSettings().control_period == 0.1

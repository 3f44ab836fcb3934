"""The loop with a network: nothing that flies leaves what is said of its control and its error."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from lagros_envs.registry import find_task
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_policies.lagros import LagrosPolicy
from lagros_policies.learning.networks import Mlp
from lagros_policies.learning.rounds import flown
from lagros_policies.proof import network_steering
from lagros_policies.proof.error_set import boxed
from lagros_policies.proof.guarantee import guarantees
from lagros_policies.proof.network_steering import NetworkSteering, network_flight
from lagros_policies.proof.plan_tube import plan_tubes
from tests.policies import plan_flights

TASK = CartPoleSettings(time_limit=2.0, initial_angle=0.1, goal_range=0.5)
GAIN = np.array([[2.0, 40.0, 4.0, 10.0]])


def scheduled(seed=0, spread=0.02):
    """Return a network whose gain balances the pole and depends a little on episode and time."""
    rng = np.random.default_rng(seed)
    last = np.zeros((30, 5))
    last[:, 1:] = spread * rng.standard_normal((30, 4)) * GAIN
    return Mlp(
        [rng.standard_normal((3, 30)) / 3.0, last],
        [rng.standard_normal(30), np.append(0.2, GAIN)],
        scheduled=4,
    )


def curved(seed=0):
    """Return a network of tanh alone that balances the pole: tanh is straight near zero."""
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((7, 12))
    rows[4:] *= 0.02
    # Neurons whose outputs add up to the gain where tanh is a line.
    sums = np.linalg.lstsq(rows[:4], GAIN[0], rcond=None)[0][:, None]
    scale = 0.02
    return Mlp([scale * rows, sums / scale], [np.zeros(12), np.zeros(1)])


def scenarios(count=3, seed=1):
    rng = np.random.default_rng(seed)
    return [TASK.sample(rng) for _ in range(count)]


def predicted(network, tmp_path, rows):
    """Return the controls that the environment takes from the policy, (s, m)."""
    path = tmp_path / "own.safetensors"
    network.save(path)
    policy = LagrosPolicy(TASK, path, allow_other_settings=True)
    actions = np.stack([policy.predict(row)[0] for row in rows])
    return np.array(TASK.control_scale) * actions.astype(np.float64)


@pytest.mark.parametrize("make", [scheduled, curved])
@pytest.mark.parametrize("size", [0.0, 0.01, 0.2])
def test_what_the_policy_answers_is_inside(make, size, tmp_path):
    network = make()
    flight = network_flight(TASK, network, scenarios())
    rng = np.random.default_rng(2)
    for step in (0, 7, 19):
        state, control = flight.states[:, step], flight.controls[:, step]
        reach = size * rng.uniform(0.1, 1.0, state.shape)
        errors = boxed(reach, 4)
        found = flight.steering.steering(step, errors, state, control)
        share = rng.uniform(-1.0, 1.0, (200, *state.shape))
        share[::2] = np.sign(share[::2])
        for plan, one in enumerate(scenarios()):
            e = share[:, plan] * reach[plan]
            rows = np.zeros((len(e), TASK.layout.size), np.float32)
            rows[:, TASK.layout.state] = state[plan] + e
            rows[:, TASK.layout.goal], rows[:, TASK.layout.initial_state] = (
                one.goal,
                one.initial_state,
            )
            rows[:, TASK.layout.time] = step * TASK.control_period
            asked = predicted(network, tmp_path, rows)
            away = asked - control[plan] - found.offset[plan] - e @ found.gain[plan].T
            assert np.all(np.abs(away) <= found.radius[plan])
        if make is scheduled:
            # Nothing but rounding.
            assert np.all(found.radius < 1e-3)


@pytest.mark.parametrize("make", [scheduled, curved])
def test_no_flight_crosses_the_tube_of_a_network(make, tmp_path):
    network, bound = make(), 0.02
    episodes = scenarios()
    flight = network_flight(TASK, network, episodes)
    tubes = plan_tubes(
        TASK.system, TASK.control_period, flight.states, flight.controls, flight.steering, bound
    )
    assert np.all(tubes.closed)
    rng = np.random.default_rng(3)
    most = 0.0
    for plan, one in enumerate(episodes):
        states, controls = flight.states[plan], flight.controls[plan]
        gains = gains_of(flight)[plan]
        pushes = plan_flights.hostile(
            TASK.system, TASK.control_period, (states, controls), gains, bound, rng, 10, 2
        )
        errors = errors_of(network, one, states, pushes)
        assert np.all(np.abs(errors) <= tubes.outputs[plan])
        most = max(most, np.max(np.abs(errors[:, -1]) / tubes.outputs[plan, -1]))
    # And the search comes near: the tube is not wide of it.
    assert most > 0.75


def gains_of(flight, count=TASK.steps):
    """Return the gains about the flights, shape (p, N, m, n)."""
    least = boxed(np.full(flight.states[:, 0].shape, 1e-6), 4)
    steps = range(count)
    places = [(step, least, flight.states[:, step], flight.controls[:, step]) for step in steps]
    return np.stack([flight.steering.steering(*place).gain for place in places], axis=1)


def errors_of(network, scenario, nominal, pushes):
    """Return the errors (f, N + 1, n) of flights of the network under pushes (f, N, n)."""
    states = flown(TASK, network, [scenario] * len(pushes), pushes)
    return states - nominal


def shipped():
    """Return the paper's task and the network of its (c)."""
    task = CartPoleSettings()
    return task, LagrosPolicy(task).network


def test_the_shipped_network_is_proved_where_nothing_but_a_bound_is_known():
    task, network = shipped()
    episodes = [task.sample(np.random.default_rng(seed)) for seed in range(2)]
    flight = network_flight(task, network, episodes)
    tubes = plan_tubes(
        task.system, task.control_period, flight.states, flight.controls, flight.steering, 0.05
    )
    found = guarantees(
        task,
        np.array([one.goal for one in episodes]),
        np.zeros((2, 0, 3)),
        flight.states,
        flight.controls,
        tubes,
    )
    assert found.holds.all()


@pytest.mark.slow
def test_thousands_of_flights_stay_in_the_tubes_of_the_shipped_network():
    task, network = shipped()
    bound, rng = 0.2, np.random.default_rng(5)
    episodes = [task.sample(np.random.default_rng(seed)) for seed in range(100, 110)]
    flight = network_flight(task, network, episodes)
    tubes = plan_tubes(
        task.system, task.control_period, flight.states, flight.controls, flight.steering, bound
    )
    assert tubes.closed.mean() >= 0.9
    gains, most = gains_of(flight, task.steps), []
    for plan in np.flatnonzero(tubes.closed):
        one = flight.states[plan], flight.controls[plan]
        pushes = plan_flights.hostile(
            task.system, task.control_period, one, gains[plan], bound, rng, 200, 3
        )
        states = flown(task, network, [episodes[plan]] * len(pushes), pushes)
        share = np.abs(states - one[0])[:, 1:] / tubes.outputs[plan, 1:]
        assert np.all(share <= 1.0)
        most.append(share.max())
    # A tube a tenth too small would have been crossed.
    assert np.max(most) > 0.9


def test_another_gain_crosses_what_was_proved_of_this_one():
    network, bound = scheduled(), 0.05
    episodes = scenarios(1)
    flight = network_flight(TASK, network, episodes)
    tubes = plan_tubes(
        TASK.system, TASK.control_period, flight.states, flight.controls, flight.steering, bound
    )
    wrong = scheduled()
    wrong.biases[-1][2] *= 0.6
    rng = np.random.default_rng(4)
    pushes = plan_flights.in_ball(np.repeat(rng.normal(size=(40, 1, 4)), TASK.steps, axis=1), bound)
    errors = errors_of(wrong, episodes[0], flight.states[0], pushes)
    assert np.any(np.abs(errors) > tubes.outputs[0])


def test_what_is_seen_must_be_affine(monkeypatch):
    pvtol = find_task("pvtol")
    view = network_steering.view_of(pvtol)
    network = Mlp([np.zeros((len(view.names), 2))], [np.zeros(2)])
    with pytest.raises(ValueError, match="affine"):
        NetworkSteering(pvtol, network, np.ones((1, 3, pvtol.layout.size), np.float32))

    def squared(observation, functions):
        return SimpleNamespace(features=[observation[0] ** 2, observation[12]], signs=())

    squared.affine = 1
    monkeypatch.setattr(network_steering, "view_of", lambda task: squared)
    rows = np.ones((1, 3, TASK.layout.size), np.float32)
    plain = Mlp([np.zeros((2, 1))], [np.zeros(1)])
    with pytest.raises(ValueError, match="said to be affine"):
        NetworkSteering(TASK, plain, rows)
    squared.affine = 0
    monkeypatch.setattr(network_steering, "view_of", lambda task: squared)
    with pytest.raises(ValueError, match="not affine"):
        NetworkSteering(TASK, plain, rows)


def test_a_gain_that_is_scheduled_by_the_state_is_refused():
    wide = Mlp([np.zeros((2, 6))], [np.zeros(6)], scheduled=5)
    with pytest.raises(ValueError, match="scheduled by"):
        NetworkSteering(TASK, wide, np.ones((1, 3, TASK.layout.size), np.float32))

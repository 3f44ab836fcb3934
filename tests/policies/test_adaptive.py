"""The adaptive law: its Lyapunov inequality, its estimate, and the error with and without it."""

from dataclasses import replace

import numpy as np
import pytest

from lagros_envs.dynamics import hold_step
from lagros_envs.seeding import episode_seeds, episode_streams
from lagros_envs.tasks.cartpole import task
from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_policies.contraction import HeldControl
from lagros_policies.contraction.control import error_energy
from lagros_policies.remarks.adaptive import (
    AdaptiveControl,
    largest_gain,
)
from lagros_policies.tasks.cartpole.planner import CartPolePlanner
from lagros_policies.tasks.cartpole.remarks import (
    cart_mass_regressor,
    friction_regressor,
)
from tests.policies.shipped import shipped_metric


def slope_regressor(state, control):
    """Return Y = 1: a is a constant force, as of a track that is not level."""
    return np.ones((*state.shape[:-1], 1))


PERIOD, MODEL = 0.1, CartPole()


@pytest.fixture(scope="module")
def law():
    metric = shipped_metric()
    return HeldControl(MODEL, metric, metric.contraction_rate, PERIOD)


@pytest.fixture(scope="module")
def plans():
    """Return x_d (8, 91, 4) and u_d (8, 90, 1) of random episodes that do not lean far."""
    planner, found = CartPolePlanner(task.CartPoleSettings(initial_angle=0.6)), []
    for seed in episode_seeds(3, 8, 991):
        scenario = planner.task.sample(episode_streams(seed).scenario)
        found.append(planner.plan(scenario.initial_state, scenario.goal))
    assert all(plan.solved for plan in found)
    return np.stack([p.states for p in found]), np.stack([p.controls for p in found])


def fly(adaptive, plans, system, force_offset=0.0):
    """Track the plans; return states (s, N + 1, 4) and estimates (s, N + 1, k)."""
    nominal, forces = plans
    state, estimate = nominal[:, 0], np.zeros((len(nominal), len(adaptive.gain)))
    path, estimates = [state], [estimate]
    for step in range(forces.shape[1]):
        force, wanted = adaptive.control(state, nominal[:, step], forces[:, step], estimate)
        following = hold_step(system, state, force + force_offset, PERIOD)
        estimate = adaptive.update(estimate, state, wanted, following, nominal[:, step + 1])
        state = following
        path.append(state)
        estimates.append(estimate)
    return np.stack(path, axis=1), np.stack(estimates, axis=1)


def rms(states, plans):
    return np.sqrt(np.mean(np.sum((states - plans[0]) ** 2, axis=-1)))


def test_the_lyapunov_inequality_holds_at_every_step(law, plans):
    # A constant force on the channel: Y a is constant over the hold, as the derivation asks.
    truth = 1.2
    gain = largest_gain(law, (1.0,))
    states, estimates = fly(AdaptiveControl(law, slope_regressor, gain), plans, MODEL, truth)
    energy = error_energy(law.metric.matrix(states), states - plans[0])
    distance = (truth - estimates[..., 0]) ** 2 / gain[0]
    kappa = 0.9 * -np.expm1(-2.0 * law.rate * PERIOD)
    before = np.exp(-2.0 * law.rate * PERIOD) * energy[:, :-1] + distance[:, :-1]
    after = (1.0 - kappa) * energy[:, 1:] + distance[:, 1:]
    # u* predicts M at the state that u_d would reach, which errs by a little.
    assert np.all(after <= before + 0.02 * energy[:, :-1] + 1e-9)
    # And it is not idle: what is left of the error of the estimate, after 9 s.
    assert np.all(np.abs(estimates[:, -1, 0] - truth) < 0.35 * truth)


@pytest.mark.parametrize("friction", [1.2, 1.8])
def test_wrong_friction_is_found_and_the_error_falls(law, plans, friction):
    truth = replace(MODEL, cart_friction=friction)
    gain = largest_gain(law, (1.5,))
    without, _ = fly(AdaptiveControl(law, friction_regressor, (0.0,)), plans, truth)
    states, estimates = fly(AdaptiveControl(law, friction_regressor, gain), plans, truth)
    assert rms(states, plans) < 0.7 * rms(without, plans)
    assert np.all(np.abs(states[:, -1] - plans[0][:, -1]) < 1.0)
    # Little of the friction shows in an episode in which the cart hardly moves.
    moved = np.abs(plans[0][:, -1, 0]) > 2.0
    assert moved.sum() >= 2
    found = np.median(estimates[moved, -1, 0])
    assert found == pytest.approx(friction - MODEL.cart_friction, rel=0.35)


def test_wrong_mass_is_compensated(law, plans):
    truth = replace(MODEL, cart_mass=1.4)
    regressor = cart_mass_regressor(MODEL)
    without, _ = fly(AdaptiveControl(law, regressor, (0.0,)), plans, truth)
    adaptive = AdaptiveControl(law, regressor, largest_gain(law, (8.0,)), limit=(0.8,))
    states, _ = fly(adaptive, plans, truth)
    assert rms(states, plans) < 0.8 * rms(without, plans)


def test_a_right_estimate_makes_the_true_system_move_as_the_model_does():
    rng = np.random.default_rng(0)
    state = rng.uniform(-0.8, 0.8, (30, 4))
    wanted = rng.uniform(-10.0, 10.0, (30, 1))
    for truth, regressor, value in (
        (replace(MODEL, cart_friction=2.0), friction_regressor, 1.5),
        (replace(MODEL, cart_mass=1.7), cart_mass_regressor(MODEL), 0.7),
    ):
        force = wanted - regressor(state, wanted) * value
        short = 1e-4  # Y is that of the beginning of the hold
        moved = hold_step(truth, state, force, short) - state
        meant = hold_step(MODEL, state, wanted, short) - state
        assert moved / short == pytest.approx(meant / short, abs=2e-2)


def test_nothing_is_learned_where_nothing_is_wrong(law, plans):
    adaptive = AdaptiveControl(law, friction_regressor, largest_gain(law, (1.5,)))
    states, estimates = fly(adaptive, plans, MODEL)
    assert np.abs(estimates).max() < 1e-5
    assert states == pytest.approx(plans[0], abs=1e-4)


def test_the_estimate_moves_along_the_push_in_the_metric_where_the_step_ends(law):
    rng = np.random.default_rng(2)
    state, following = rng.uniform(-0.8, 0.8, (2, 20, 4))
    nominal, estimate = rng.uniform(-0.8, 0.8, (20, 4)), rng.uniform(-0.5, 0.5, (20, 1))
    wanted = rng.uniform(-10.0, 10.0, (20, 1))
    ahead, behind = (hold_step(MODEL, state, wanted + sign * 1e-4, PERIOD) for sign in (1.0, -1.0))
    push = (ahead - behind) / 2e-4
    matrix = np.stack([law.metric.matrix(one) for one in following])
    pull = np.sum(push * (matrix @ (following - nominal)[..., None])[..., 0], axis=-1)
    moved = AdaptiveControl(law, friction_regressor, (0.3,)).update(
        estimate, state, wanted, following, nominal
    )
    wanted_move = 0.3 * -state[:, 2] * pull
    assert (moved - estimate)[:, 0] == pytest.approx(wanted_move, rel=1e-5)


def test_gain_keeps_kappa_below_its_limit(law):
    rng = np.random.default_rng(1)
    reach = (1.5, 8.0)
    gain = np.array(largest_gain(law, reach, share=0.5))
    state = np.zeros((200, 4))
    state[:, 1] = rng.uniform(-law.metric.region.angle, law.metric.region.angle, 200)
    # dF/du by differences.
    force = np.full((200, 1), 1e-4)
    push = (hold_step(MODEL, state, force, PERIOD) - hold_step(MODEL, state, -force, PERIOD)) / 2e-4
    kappa = np.sum(gain * np.square(reach)) * error_energy(law.metric.matrix(state), push)
    limit = 0.5 * (1.0 - np.exp(-2.0 * law.rate * PERIOD))
    assert np.all(kappa <= limit * 1.01)
    assert kappa.max() > 0.9 * limit


def test_leakage_forgets_and_projection_holds(law):
    adaptive = AdaptiveControl(law, slope_regressor, (0.0,), leakage=2.0, limit=(0.5,))
    state = np.zeros((1, 4))
    update = adaptive.update(np.array([[0.4]]), state, np.zeros((1, 1)), state, state)
    assert update == pytest.approx(np.array([[0.4 * 0.8]]))
    update = adaptive.update(np.array([[3.0]]), state, np.zeros((1, 1)), state, state)
    assert update == pytest.approx(np.array([[0.5]]))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"gain": ()}, "gain"),
        ({"gain": (-1.0,)}, "gain"),
        ({"gain": (1.0,), "leakage": 11.0}, "leakage"),
        ({"gain": (1.0,), "limit": (1.0, 1.0)}, "limit"),
    ],
)
def test_wrong_settings_are_named(law, settings, message):
    with pytest.raises(ValueError, match=message):
        AdaptiveControl(law, slope_regressor, **settings)
    with pytest.raises(ValueError, match="reach"):
        largest_gain(law, (0.0,))

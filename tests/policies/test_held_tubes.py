"""The tube of a held control: its program, its proof, and flights that try to leave it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import BPoly

from lagros_policies.contraction import held_ellipsoid
from lagros_policies.contraction.cvstem import InfeasibleError
from lagros_policies.contraction.held_design import (
    HeldDesign,
    bernstein_rate,
    design_held_contained,
)
from lagros_policies.contraction.held_ellipsoid import (
    _falls_at_instants,
    prove_held_tube,
)
from lagros_policies.proof.cells import Search
from lagros_policies.tasks.cartpole.plans import PlanBox

PLAN = PlanBox(angle=0.05, velocity=0.3, angular_rate=0.1, force=0.3)
BOUND, PERIOD = 0.1, 0.1


@pytest.fixture(scope="module", params=[False, True], ids=["periodic", "aperiodic"])
def tube(request, system):
    design = HeldDesign(
        period=PERIOD, disturbance_bound=BOUND, degree=3, aperiodic=request.param, rate=0.5
    )
    return design_held_contained(system, PLAN, design)


def test_it_is_proved(system, tube):
    proof = prove_held_tube(system, tube, 60.0)
    assert proof.proved
    # Worth having: below ten times the disturbance, in spite of the hold.
    assert tube.steady_radius < 10 * BOUND


def test_spoiled_tubes_are_refused(system, tube):
    more = replace(tube.design, disturbance_bound=1.2 * BOUND)
    longer = replace(tube.design, period=1.2 * PERIOD)
    for spoiled in (
        replace(tube, duals=0.9 * tube.duals),
        replace(tube, design=more),
        replace(tube, design=longer),
        replace(tube, design=replace(tube.design, rate=1.2 * tube.design.rate)),
        replace(tube, gain=0.9 * tube.gain),
        replace(tube, error=0.9 * tube.error),
        replace(tube, plan=replace(PLAN, angle=0.6), error=tube.error),
    ):
        assert not prove_held_tube(system, spoiled, 2.0).proved


@pytest.mark.parametrize("tube", [True], indirect=True, ids=["aperiodic"])
def test_a_gain_that_shorter_holds_do_not_allow_is_refused(tube):
    """After a hold of no length V must not rise: with K = Y W_0^-1 alone, Q_0 - L W_0 L' >= 0."""
    assert _falls_at_instants(tube)
    other = replace(tube, gain=tube.gain * (1.0 + 1e-5))
    assert not _falls_at_instants(other)
    # Over whole holds there is room for as much.
    assert _falls_at_instants(replace(other, design=replace(tube.design, aperiodic=False)))
    # What the proof of the ends says of every W between the shortest hold and the longest.
    joined = np.concatenate([np.eye(4), tube.gain])
    for phase in (1e-3, 0.1, 0.5, 1.0):
        moved = joined @ tube.dual_at(phase)[:4, :4] @ joined.T
        assert np.linalg.eigvalsh(tube.duals[0] - moved)[0] > 0.0


def test_every_coefficient_counts(tube):
    """One in the middle that is larger widens the bounds, and is one of the instants or is not."""
    duals = tube.duals.copy()
    duals[1] *= 2.0
    other = replace(tube, duals=duals)
    errors = np.linalg.cholesky(duals[1])[:4, :4]
    for output in np.eye(4):
        assert other.output_radius(output, 1e3) >= np.linalg.norm(output @ errors) * (1 - 1e-9)
    assert np.all(other.steady_outputs >= np.sqrt(np.diag(duals[1])[:4]))
    assert other.steady_radius >= np.linalg.norm(errors, ord=2)
    assert _falls_at_instants(other) != tube.design.aperiodic


@pytest.mark.parametrize("failing", range(4))
def test_a_coefficient_that_is_not_proved_leaves_no_tube(system, tube, monkeypatch, failing):
    calls = []

    def search(*_):
        calls.append(None)
        return Search(len(calls) != failing + 1, 1, 0.0)

    monkeypatch.setattr(held_ellipsoid, "search", search)
    assert not prove_held_tube(system, tube, 1.0).proved
    calls.extend([None] * 9)
    assert prove_held_tube(system, tube, 1.0).proved


def draw(tube, count, seed):
    """Return (x, x_d, u_d) with x_d in the plan's box and e anywhere in the box of errors."""
    rng = np.random.default_rng(seed)
    nominal = rng.uniform(-1, 1, (count, 4)) * [1.0, PLAN.angle, PLAN.velocity, PLAN.angular_rate]
    error = rng.uniform(-1, 1, (count, 4)) * np.maximum(tube.error, [1.0, 0, 0, 0])
    return nominal + error, nominal, rng.uniform(-1, 1, (count, 1)) * PLAN.force


@pytest.mark.parametrize("phase", [0.0, 0.37, 0.8, 1.0])
def test_the_condition_holds_inside_the_hold_by_the_definition_of_the_sdc_matrix(
    tube, phase, oracle
):
    state, nominal, control = draw(tube, 200, 0)
    lifted = np.zeros((200, 5, 5))
    lifted[:, :4, :4] = oracle.sdc(state, nominal, control)
    lifted[:, :4, 4:] = oracle.input_matrix(state)
    step = 1e-6
    ahead, behind = (tube.dual_at(phase + sign * step) for sign in (1, -1))
    slope = (ahead - behind) / (2 * step * PERIOD)
    rate, dual = tube.design.rate, tube.dual_at(phase)
    product = lifted @ dual
    left = product + np.swapaxes(product, 1, 2) + 2 * rate * dual - slope
    left += BOUND**2 / (2 * rate) * np.diag([1.0, 1, 1, 1, 0])
    assert np.linalg.eigvalsh(left).max() < 0.0


def test_the_rate_of_a_bernstein_polynomial_is_that_of_the_polynomial():
    rng = np.random.default_rng(1)
    for degree in (1, 2, 5):
        values = rng.standard_normal(degree + 1)
        s = np.linspace(0.0, 1.0, 7)
        slope = BPoly(values[:, None], [0.0, 1.0]).derivative()(s)
        rates = [sum(w * values[i] for i, w in row.items()) for row in bernstein_rate(degree)]
        raised = BPoly(np.array(rates)[:, None], [0.0, 1.0])(s)
        assert raised == pytest.approx(slope, abs=1e-12)


def test_the_energy_does_not_rise_when_the_force_is_renewed(tube):
    rng = np.random.default_rng(2)
    error, old = rng.standard_normal((500, 4)), 30 * rng.standard_normal((500, 1))
    before = tube.energy(1.0, error, old)
    after = tube.energy(0.0, error, error @ tube.gain.T)
    assert np.all(after <= before)


@pytest.mark.parametrize("kind", ["steepest", "ahead", "constant", "switching"])
def test_no_flight_leaves_the_tube_at_any_time(tube, kind, oracle):
    """Disturbances that may change every 5 ms; the tube is looked at every 5 ms too."""
    rng = np.random.default_rng(4)
    count, parts = 40, 20
    fine = PERIOD / parts
    nominal = rng.uniform(-0.5, 0.5, (count, 4)) * [0.02, 0.01, 0.05, 0.02]
    held = rng.standard_normal((8, count, 4))
    held /= np.linalg.norm(held, axis=2, keepdims=True)
    state, reached = nominal.copy(), 0.0
    # Where e is bound to end if nothing disturbs: what the push should lean on (kind "ahead").
    last = np.linalg.inv(tube.dual_at(1.0))
    for hold in range(16):
        # A target that balances itself and is moved about.
        control = nominal @ tube.gain.T + rng.uniform(-0.03, 0.03, (count, 1))
        control = np.clip(control, -PLAN.force, PLAN.force)
        force = tube.control(state, nominal, control)
        limits = [np.inf, PLAN.angle, PLAN.velocity, PLAN.angular_rate]
        assert np.all(np.abs(nominal) <= limits)
        for part in range(parts):
            z = np.concatenate([state - nominal, force - control], axis=1) + 1e-12
            inverse = np.linalg.inv(tube.dual_at(part / parts)) if kind == "steepest" else last
            pull = (z @ inverse)[:, :4]
            push = {
                "constant": held[0],
                "switching": held[(hold * parts + part) // 7 % 8],
            }.get(kind, pull / np.linalg.norm(pull, axis=1, keepdims=True))
            state = oracle.step(state, force, fine, 1, BOUND * push)
            nominal = oracle.step(nominal, control, fine, 1)
            time, error = hold * PERIOD + (part + 1) * fine, state - nominal
            energy = tube.energy((part + 1) / parts, error, force - control)
            assert np.all(energy <= tube.share(time) ** 2 * (1 + 1e-6))
            assert np.all(np.linalg.norm(error, axis=1) <= tube.steady_radius)
            for output in np.eye(4):
                assert np.all(np.abs(error @ output) <= tube.output_radius(output, time))
            reached = max(reached, float(energy.max()))
        assert np.all(np.abs(force - control) <= tube.largest_deviation)
    # The test says something: the steepest push uses much of the tube.
    assert reached > (0.3 if kind == "steepest" else 0.01)


@pytest.mark.parametrize("tube", [True], indirect=True, ids=["aperiodic"])
def test_shorter_holds_stay_inside_an_aperiodic_tube(tube, oracle):
    rng = np.random.default_rng(5)
    state, nominal = np.zeros((40, 4)), np.zeros((40, 4))
    held, time, parts = np.zeros((40, 1)), 0.0, 20
    for _ in range(60):
        force = tube.control(state, nominal, held)
        for part in range(int(rng.integers(1, parts + 1))):
            phase = part / parts
            z = np.concatenate([state, force], axis=1) + 1e-12
            pull = (z @ np.linalg.inv(tube.dual_at(phase)))[:, :4]
            push = pull / np.linalg.norm(pull, axis=1, keepdims=True)
            state = oracle.step(state, force, PERIOD / parts, 1, BOUND * push)
            time += PERIOD / parts
            energy = tube.energy(phase + 1 / parts, state, force)
            assert np.all(energy <= tube.share(time) ** 2 * (1 + 1e-6))


def test_an_output_of_other_states_is_refused(system):
    with pytest.raises(ValueError, match="output"):
        design_held_contained(system, PLAN, HeldDesign(output=(1.0, 0.0)))


def test_a_disturbance_without_a_contained_tube_is_refused(system):
    with pytest.raises(InfeasibleError, match="disturbance"):
        design_held_contained(system, PLAN, HeldDesign(disturbance_bound=3.0, degree=3))


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"period": 0.0}, "period"),
        ({"rate": -1.0}, "rate"),
        ({"disturbance_bound": float("nan")}, "disturbance_bound"),
        ({"margin": -0.1}, "margin"),
        ({"degree": 0}, "degree"),
    ],
)
def test_values_out_of_range_are_refused(change, match):
    with pytest.raises(ValueError, match=match):
        HeldDesign(**change)

"""Every function of the theory is right for a system that is no cart-pole, or refuses it.

Right is what the brute force of `foreign` finds.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from lagros_envs.dynamics import hold_step
from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_envs.tasks.spacecraft.physics import Spacecraft
from lagros_policies import contraction
from lagros_policies.contraction import (
    BoxRegion,
    CvStemSettings,
    HeldControl,
    Metric,
    Samples,
    certified_tube,
    contraction_residual,
    control,
    cosines,
    design_metric,
    design_on_pool,
    ellipsoid,
    extreme_eigenvalues,
    held_design,
    held_ellipsoid,
    robust_control,
    search_rate,
    theorems,
    tube_design,
    verify_metric,
)
from lagros_policies.contraction.axis_gain import AxisGain
from lagros_policies.contraction.cvstem import least_condition
from lagros_policies.contraction.double_integrator import design_axis
from lagros_policies.proof import bounds, hold, sets
from lagros_policies.proof import condition as proof_condition
from lagros_policies.remarks import adaptive, lagrangian, stochastic
from lagros_policies.tasks.cartpole import (
    box,
    feedback,
    lipschitz,
    plans,
    proof_design,
    remarks,
)
from lagros_policies.tasks.cartpole import certificate as certificate_cartpole
from lagros_policies.tasks.cartpole import proof as proof_cartpole
from lagros_policies.tasks.cartpole import proof_program as program
from lagros_policies.tasks.cartpole.neural import design as neural_design
from lagros_policies.tasks.cartpole.neural import training as neural_training
from lagros_policies.tasks.cartpole.region import Region
from lagros_policies.tasks.spacecraft import certificate as certificate_spacecraft
from lagros_policies.tasks.spacecraft import (
    gain_control,
    sliding,
    thrusters,
    world_tube,
    wrench_control,
)
from lagros_policies.tasks.spacecraft import proof as proof_spacecraft
from tests.policies.foreign import (
    Pvtol,
    Ramp,
    Reordered,
    Swapped,
    Unicycle,
    brute_residual,
    drawn,
    moved,
    positive,
    reach,
)
from tests.policies.shipped import shipped_metric

BOX = box.ProofBox(0.3, 0.5, 0.5, 0.5)
PLAN = plans.PlanBox()


FOREIGN = (Ramp(), Unicycle(), Pvtol(), Reordered(), Swapped())
by_name = pytest.mark.parametrize("system", FOREIGN, ids=lambda one: type(one).__name__)


def constant_metric(n, rate=0.2, weight=3.0):
    return Metric(positive(n)[None], rate, 50.0, weight, np.ones(n), Region())


def angle_metric():
    parts = np.stack([positive(4), 0.5 * positive(4, 1), 0.2 * positive(4, 2)])
    return Metric(parts, 0.2, 50.0, 3.0, np.ones(4), Region())


class RollMetric:
    """A metric of one's own, of the PVTOL's roll, whose rate is state 5."""

    contraction_rate = 0.2
    condition_bound = 50.0
    control_weight = 3.0
    scaling = np.ones(6)
    region = Region()
    verification = None

    def dual(self, state):
        return positive(6) + np.cos(state[..., 2])[..., None, None] * positive(6, 1)

    def dual_rate(self, state, motion):
        change = -np.sin(state[..., 2]) * motion[..., 2]
        return change[..., None, None] * positive(6, 1)

    def matrix(self, state):
        return np.linalg.inv(self.dual(state))

    def matrix_rate(self, state, motion):
        matrix = self.matrix(state)
        return -matrix @ self.dual_rate(state, motion) @ matrix

    def verified(self, check):
        self.verification = check
        return self


# General functions, against brute force.


@by_name
def test_the_condition_of_a_constant_metric_is_that_of_any_system(system):
    metric, samples = constant_metric(system.state_dim), drawn(system)
    expected = brute_residual(system, metric, samples)
    assert contraction_residual(system, metric, samples) == pytest.approx(expected, rel=1e-6)
    checked = verify_metric(system, metric, samples, 3).verification
    bounded = np.linalg.eigvalsh(metric.dual(samples.state))
    outside = (bounded[:, 0] < 1.0) | (bounded[:, -1] > 50.0)
    assert checked.violations == int(np.sum((expected > 0.0) | outside))
    assert checked.worst == pytest.approx(expected.max(), rel=1e-6)


def test_a_metric_of_an_angle_is_right_or_refused():
    samples = drawn(Swapped())
    expected = brute_residual(Swapped(), angle_metric(), samples)
    found = contraction_residual(Swapped(), angle_metric(), samples)
    assert found == pytest.approx(expected, rel=1e-4, abs=1e-6)
    # The same numbers as [theta, dtheta/dt, p, dp/dt]: state 1 is no angle.
    for ask in (
        lambda: contraction_residual(Reordered(), angle_metric(), drawn(Reordered())),
        lambda: verify_metric(Reordered(), angle_metric(), drawn(Reordered()), 0),
    ):
        with pytest.raises(ValueError, match=r"control 0 of Reordered.* moves a metric of the"):
            ask()


def test_a_metric_of_one_s_own_brings_its_own_rate():
    metric, samples = RollMetric(), drawn(Pvtol())
    expected = brute_residual(Pvtol(), metric, samples)
    assert expected.max() > 0.69
    assert contraction_residual(Pvtol(), metric, samples) == pytest.approx(expected, rel=1e-6)
    assert verify_metric(Pvtol(), metric, samples, 0).verification.violations > 0
    # What is asked of its angles alone has no answer: it depends on another state.
    for ask in (
        lambda: extreme_eigenvalues(metric),
        lambda: certified_tube(metric, 0.1),
        lambda: stochastic.mean_square_bound(metric, np.full(6, 0.1)),
    ):
        with pytest.raises(ValueError, match="depends on more"):
            ask()


def test_a_metric_of_the_angle_is_of_four_states():
    parts = np.stack([positive(6), 0.1 * positive(6, 1)])
    with pytest.raises(ValueError, match="is of 4 states, and the metric is of 6"):
        Metric(parts, 0.2, 50.0, 3.0, np.ones(6), Region())
    for n in (1, 2, 3, 6):
        metric = constant_metric(n)
        assert np.array_equal(metric.dual(np.ones((5, n))), np.tile(positive(n), (5, 1, 1)))
        assert not metric.dual_rate(np.ones(n), np.ones(n)).any()
        values = np.linalg.eigvalsh(np.linalg.inv(positive(n)))
        assert extreme_eigenvalues(metric) == pytest.approx((values[0], values[-1]))
        tube = certified_tube(metric, 0.3)
        assert tube.steady_radius == pytest.approx(0.3 / 0.2 * np.sqrt(values[-1] / values[0]))
        with pytest.raises(ValueError, match=f"of {n} states"):
            metric.dual(np.ones(n + 1))


@pytest.mark.parametrize("degree", [0, 2])
@by_name
def test_a_design_holds_by_brute_force_or_is_refused(system, degree):
    n = system.state_dim
    samples = drawn(system, 40)
    settings = CvStemSettings(0.05, degree, 0.1, 0.05, (1.0,) * n)
    region: Any = Region()
    if degree and n != 4:
        with pytest.raises(ValueError, match=rf"is of 4 states, and the metric is of {n}"):
            design_metric(system, samples, region, settings)
        settings = replace(settings, basis=cosines(1, degree))
        m = system.control_dim
        region = BoxRegion((-0.7,) * n, (0.7,) * n, (0.3,) * n, (-1.0,) * m, (1.0,) * m)

    def design():
        return design_metric(system, samples, region, settings)

    if degree and not isinstance(system, Swapped | Pvtol):
        for ask in (
            design,
            lambda: design_on_pool(system, samples, region, settings),
            lambda: search_rate(system, samples, region, settings, [0.05]),
            lambda: least_condition(system, samples, region, settings),
        ):
            with pytest.raises(ValueError, match=r"control 0 of .* moves a metric of the state"):
                ask()
        return
    try:
        metric = design()
    except contraction.InfeasibleError:
        # The unicycle and the upright pole without its angle have no such metric.
        assert isinstance(system, Unicycle | Swapped | Pvtol)
        with pytest.raises(contraction.InfeasibleError):
            least_condition(system, samples, region, settings)
        return
    assert brute_residual(system, metric, samples).max() <= 0.0
    # The first program of the design: its bounds are at a few places, so that it is no worse.
    least = least_condition(system, samples, region, settings)
    assert 1.0 <= least <= metric.condition_bound * 1.02


def test_scalings_and_samples_of_another_system_are_refused():
    settings = CvStemSettings(degree=0)
    with pytest.raises(ValueError, match=r"scaling of shape \(4,\) must be \(..., 2\)"):
        design_metric(Ramp(), drawn(Ramp()), Region(), settings)
    for system, other in ((Pvtol(), Unicycle()), (CartPole(), Ramp()), (Ramp(), CartPole())):
        metric = constant_metric(system.state_dim)
        with pytest.raises(ValueError, match="state of shape"):
            contraction_residual(system, metric, drawn(other))
        with pytest.raises(ValueError, match=r"of \d states"):
            contraction_residual(system, constant_metric(other.state_dim), drawn(system))
    samples = drawn(CartPole())
    with pytest.raises(ValueError, match="nominal_control must be finite"):
        Samples(samples.state, samples.nominal, np.full_like(samples.nominal_control, np.nan))
    with pytest.raises(ValueError, match="must be"):
        Samples(samples.state, samples.nominal[:-1], samples.nominal_control)
    with pytest.raises(ValueError, match="empty"):
        verify_metric(CartPole(), shipped_metric(), samples.take(np.zeros(0, np.intp)), 0)


@dataclass(frozen=True)
class Wavy:
    """One state whose slope turns so often that sixteen nodes do not see it."""

    state_dim = 1
    control_dim = 1

    def derivative(self, state, control, functions):
        return (functions.sin(200.0 * state[0]) + control[0],)


def test_a_slope_that_the_quadrature_cannot_see_is_refused():
    samples = Samples(np.array([[2.0]]), np.array([[0.0]]), np.zeros((1, 1)))
    with pytest.raises(ValueError, match="changes too often"):
        contraction_residual(Wavy(), constant_metric(1), samples)
    near = Samples(np.array([[0.01]]), np.array([[0.0]]), np.zeros((1, 1)))
    expected = brute_residual(Wavy(), constant_metric(1), near)
    assert contraction_residual(Wavy(), constant_metric(1), near) == pytest.approx(expected)


@by_name
def test_controls_of_a_constant_metric_contract_by_brute_force(system):
    metric, samples = constant_metric(system.state_dim), drawn(system)
    args = (samples.state, samples.nominal, samples.nominal_control)
    error = samples.state - samples.nominal
    matrix = np.linalg.inv(metric.coefficients[0])
    u = robust_control(system, metric, 0.2, *args)
    fall = moved(system, samples.state, u) - moved(system, samples.nominal, args[2])
    energy = np.einsum("si,ij,sj->s", error, matrix, error)
    change = 2.0 * np.einsum("si,ij,sj->s", error, matrix, fall)
    assert np.all(change <= -2.0 * 0.2 * energy + 1e-9 * np.abs(change).max())
    distance = theorems.contraction_distance(system, metric, samples, args[2])
    away = np.linalg.norm(u - args[2], axis=-1)
    assert distance == pytest.approx(away, rel=1e-6, abs=1e-9)
    feasible = args[2] - 3.0 * np.einsum("sij,si->sj", reach(system, samples.state), error @ matrix)
    fall = moved(system, samples.state, feasible) - moved(system, samples.nominal, args[2])
    missed = 2.0 * np.einsum("si,ij,sj->s", error, matrix, fall) / energy + 2.0 * 0.2
    assert theorems.feasibility_residual(system, metric, samples) == pytest.approx(missed, rel=1e-6)


def test_controls_of_a_metric_of_the_angle_are_refused_elsewhere():
    samples = drawn(Reordered())
    args = (samples.state, samples.nominal, samples.nominal_control)
    for ask in (
        lambda: control.contraction_terms(Reordered(), angle_metric(), 0.2, *args),
        lambda: robust_control(Reordered(), angle_metric(), 0.2, *args),
        lambda: theorems.feasibility_residual(Reordered(), angle_metric(), samples),
        lambda: theorems.contraction_distance(Reordered(), angle_metric(), samples, args[2]),
    ):
        with pytest.raises(ValueError, match=r"control 0 of .* moves a metric of the state"):
            ask()
    with pytest.raises(ValueError, match="states"):
        robust_control(Pvtol(), angle_metric(), 0.2, *args)


def test_a_held_control_is_of_the_states_of_its_metric():
    with pytest.raises(ValueError, match="the metric is of 4 states"):
        HeldControl(Ramp(), angle_metric(), 0.1, 0.1)
    # For an angle that it does not turn by itself it is right: it asks for no rate.
    law, samples = HeldControl(Ramp(), constant_metric(2), 0.2, 0.05), drawn(Ramp())
    u = law(samples.state, samples.nominal, samples.nominal_control)
    assert u.shape == (50, 1)


def test_the_mean_square_of_a_constant_metric_is_that_of_any_states():
    intensity = np.array([0.1, 0.2, 0.3])
    matrix = np.linalg.inv(positive(3))
    bound = stochastic.mean_square_bound(constant_metric(3), intensity)
    assert bound.power == pytest.approx(np.trace(np.diag(intensity) @ matrix @ np.diag(intensity)))
    assert bound.rate == 0.2
    with pytest.raises(ValueError, match="3 finite numbers"):
        stochastic.mean_square_bound(constant_metric(3), np.full(4, 0.1))
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="6 finite numbers"):
        stochastic.noisy_hold_step(Pvtol(), np.zeros(6), np.zeros(2), 0.1, np.full(4, 0.1), rng)


def test_a_region_is_of_the_cartpole_alone():
    with pytest.raises(ValueError, match="four states"):
        Region().contains(np.zeros(6), np.zeros(6), np.zeros(2))
    assert Region().contains(np.zeros(4), np.zeros(4), np.zeros(1))


def test_weights_of_the_cartpole_serve_no_other_plans():
    by_state, by_control = np.zeros((1, 5, 6, 6)), np.zeros((1, 5, 6))
    with pytest.raises(ValueError, match="the plans have 6"):
        feedback.gain_table(feedback.FeedbackSettings(), by_state, by_control, np.arange(6) * 0.1)
    with pytest.raises(ValueError, match="one control"):
        feedback.gain_table(
            feedback.FeedbackSettings(), by_state, np.zeros((1, 5, 6, 2)), np.arange(6) * 0.1
        )


# What uses more of the structure refuses.


@dataclass(frozen=True, slots=True)
class Spinner(Spacecraft):
    """A spacecraft whose reach depends on its spin."""

    def derivative(self, state, control, functions):
        rates = list(Spacecraft.derivative(self, state, control, functions))
        rates[3] = rates[3] * (1.0 + state[5] * state[5])
        return rates


def cartpole_calls(system: Any) -> Iterator[tuple[Callable[..., Any], Callable[[], Any]]]:
    """Yield what is for the cart-pole alone, and a call of it for another system."""
    metric, samples = shipped_metric(), drawn(CartPole())
    tube = tube_design.ConstantTube(tube_design.TubeDesign(), np.eye(4), 1.0, PLAN, np.ones(4))
    held = held_design.HeldTube(
        held_design.HeldDesign(), np.tile(np.eye(5), (7, 1, 1)), np.zeros((1, 4)), PLAN, np.ones(4)
    )
    question = certificate_cartpole.CartPoleQuestion(BOX, 0.1, 0.0, 3.15)
    whole = program.ProvedDesignSettings()
    small, design = np.full(4, 0.1), tube_design.TubeDesign()
    solution = neural_design.AngleSolution(
        np.array([0.0, 1.0]), np.tile(np.eye(4), (2, 1, 1)), 0.1, 1.0, 1.0, np.ones(4)
    )

    def solve(function):
        return lambda: function(system, samples, Region(), CvStemSettings(), 3)

    for function, ask in {
        proof_condition.prove_contraction: lambda f: f(system, metric, BOX),
        proof_condition.largest_proved: lambda f: f(system, metric, BOX),
        proof_cartpole.prove_cartpole: lambda f: f(metric, BOX, system),
        proof_design.design_proved: lambda f: f(whole, system),
        hold.prove_hold: lambda f: f(system, metric, BOX),
        sets.triples: lambda f: f(BOX, system, "state"),
        sets.held_triples: lambda f: f(BOX, system),
        lipschitz.lipschitz_constant: lambda f: f(system, BOX),
        program.corners: lambda f: f(system, BOX),
        program.design_on_points: lambda f: f(system, samples, samples, whole),
        tube_design.design_constant: lambda f: f(system, PLAN, small, design),
        tube_design.design_contained: lambda f: f(system, PLAN, design),
        held_design.design_held: lambda f: f(system, PLAN, small, held_design.HeldDesign()),
        held_design.design_held_contained: lambda f: f(system, PLAN, held_design.HeldDesign()),
        ellipsoid.prove_tube: lambda f: f(system, tube),
        held_ellipsoid.prove_held_tube: lambda f: f(system, held),
        certificate_cartpole.cartpole_certificate: lambda f: f(system, metric, question),
        remarks.cart_mass_regressor: lambda f: f(system),
        neural_training.fit_network: lambda f: f(system, samples, solution, Region()),
    }.items():
        yield function, lambda function=function, ask=ask: ask(function)
    for function in (neural_design.solve_at_angles, neural_design.solve_on_pool):
        yield function, solve(function)


def spacecraft_calls(body: Any) -> Iterator[tuple[Callable[..., Any], Callable[[], Any]]]:
    """Yield what is for the spacecraft alone, and a call of it for another body."""
    plane = design_axis(1.0)
    axis, gain, one = lagrangian.SlidingAxis(), AxisGain.of_rate(2.0), np.ones(1)
    planned = world_tube.Planned(one, one, one, np.zeros((1, 2)), 1.0)
    state, wrench = np.zeros(6), np.zeros(3)
    certificate = {"disturbance_bound": 0.4, "paper_radius": 1.0}
    for function, ask in {
        thrusters.allocate: lambda f: f(body, wrench),
        thrusters.allocation_matrix: lambda f: f(body),
        thrusters.wrench_of_acceleration: lambda f: f(body, state, wrench),
        thrusters.thrust_for_acceleration: lambda f: f(body, state, wrench),
        thrusters.held_thrust: lambda f: f(body, state, wrench, 0.1),
        wrench_control.AxesTracking: lambda f: f(body, plane, plane),
        wrench_control.WrenchTracking: lambda f: f(body, plane, plane),
        sliding.SlidingTracking: lambda f: f(body, axis, axis),
        gain_control.GainTracking: lambda f: f(body, gain, gain),
        gain_control.tracking_law: lambda f: f("gain", body, 0.1, 2.0, 0.3),
        world_tube.thrust_rounding: lambda f: f(body, np.ones(2), 0.1),
        world_tube.world_tube: lambda f: f(body, gain, gain, planned, 0.2, 3),
        proof_spacecraft.control_square: lambda f: f(body),
        proof_spacecraft.prove_spacecraft: lambda f: f(plane, None, body),
        certificate_spacecraft.spacecraft_certificate: lambda f: f(
            plane, plane, body, **certificate
        ),
    }.items():
        yield function, lambda function=function, ask=ask: ask(function)


@pytest.mark.parametrize("system", [*FOREIGN, Spacecraft()], ids=lambda one: type(one).__name__)
def test_what_is_for_the_cartpole_alone_refuses_every_other_system(system):
    for function, call in cartpole_calls(system):
        with pytest.raises(TypeError, match=r"must be a CartPole"):
            call()
        assert function.__doc__


@pytest.mark.parametrize("body", [Spinner(), CartPole(), Pvtol()], ids=lambda one: repr(one)[:7])
def test_what_is_for_the_spacecraft_alone_refuses_every_other_body(body):
    for _, call in spacecraft_calls(body):
        with pytest.raises(TypeError, match=r"must be a Spacecraft"):
            call()


def test_the_reach_of_a_foreign_system_is_not_bounded_by_that_at_zero():
    """Read at states that are zero but for state 1, its ||B|| would be "proved" to be 1."""
    metric, box = constant_metric(2), ([-2.0, -1.0], [2.0, 1.0])
    assert np.abs(reach(Ramp(), np.array([[np.pi / 2, 0.0]]))).max() == 51.0
    assert 51.0 <= bounds.prove_bounds(Ramp(), metric, *box).control_gain < 51.1
    # Where x_0 is free nothing bounds it.
    with pytest.raises(ValueError, match=r"x\[0\] <= inf is not bounded"):
        bounds.prove_bounds(Ramp(), metric, [-np.inf, -1.0], [np.inf, 1.0])


def test_what_proves_takes_a_polynomial_of_the_states_of_the_system():
    network = RollMetric()
    with pytest.raises(TypeError, match="must be a Metric"):
        bounds.prove_bounds(CartPole(), network, [0.0] * 4, [1.0] * 4)
    with pytest.raises(TypeError, match="must be a Metric"):
        bounds.metric_drift(network, 0.0, 0.5)
    for function in (proof_condition.prove_contraction, hold.prove_hold):
        with pytest.raises(TypeError, match="must be a Metric"):
            function(CartPole(), network, BOX)
        with pytest.raises(ValueError, match=r"scaling of shape \(6,\)"):
            function(CartPole(), constant_metric(6), BOX)


def test_regressors_and_gains_are_those_of_the_cartpole():
    with pytest.raises(ValueError, match="cart-pole's"):
        remarks.friction_regressor(np.zeros(6), np.zeros(1))
    law = HeldControl(Pvtol(), constant_metric(6), 0.2, 0.05)
    with pytest.raises(ValueError, match="has 2 controls: largest_gain is for one"):
        adaptive.largest_gain(law, (1.0,))
    # For one control it is that of any system: the largest G'MG by another way.
    law = HeldControl(Ramp(), constant_metric(2), 0.2, 0.05)
    (gain,) = adaptive.largest_gain(law, (1.0,), 0.5)
    step = 1e-6
    states = np.stack([np.zeros(41), np.linspace(0.0, Region().angle, 41)], axis=-1)
    ahead, behind = (
        hold_step(Ramp(), states, np.full((41, 1), sign * step), 0.05) for sign in (1.0, -1.0)
    )
    push = (ahead - behind) / (2.0 * step)
    matrix = np.linalg.inv(positive(2))
    largest = np.einsum("si,ij,sj->s", push, matrix, push).max()
    assert gain * largest == pytest.approx(0.5 * (1.0 - np.exp(-2.0 * 0.2 * 0.05)))


# What is right for any system, by the tests above or because it asks nothing of it.
GENERAL = {
    *(
        "contraction.condition.condition_terms",
        "contraction.condition.condition_left",
        "contraction.condition.contraction_residual",
    ),
    *(
        "contraction.condition.verify_metric",
        "contraction.control.contraction_terms",
        "contraction.control.robust_control",
    ),
    *(
        "contraction.control.HeldControl",
        "contraction.control.contracting_set",
        "contraction.cvstem.design_metric",
        "contraction.cvstem.design_on_pool",
        "contraction.cvstem.least_condition",
        "contraction.cvstem.search_rate",
    ),
    *("remarks.adaptive.AdaptiveControl",),
    *("proof.bounds.prove_bounds", "proof.condition.bounds_statement", "proof.condition.prove"),
    *(f"proof.enclosures.{name}" for name in ("slopes", "held_slopes")),
    *(
        f"proof.families.{name}"
        for name in ("rate_matrices", "hold_matrices", "lifted_matrices", "held_ends")
    ),
    *("proof.guarantee.nominal_between", "proof.plan_tube.plan_tubes", "proof.plan_tube.curved"),
    *("proof.between.holds", "proof.between.errors_between", "proof.hold_error.HoldOfErrors"),
    *("contraction.sampled.push_slope", "contraction.sampled.design_sampled"),
    *("contraction.ellipsoid.TubeControl", "tasks.cartpole.box.balance"),
    *(
        "remarks.stochastic.noisy_hold_step",
        "contraction.theorems.feasibility_residual",
    ),
    *("contraction.theorems.contraction_distance", "remarks.adaptive.largest_gain"),
    *("contraction.systems.check_sizes", "tasks.cartpole.systems.check_cartpole"),
    *(
        "contraction.cvstem.design_on_region",
        "contraction.cvstem_program.resolved",
        "contraction.cvstem_program.condition_rows",
    ),
    *(
        "contraction.systems.check_unmoved",
        "contraction.systems.check_basis_unmoved",
        "contraction.condition.search_violation",
    ),
}


def test_every_public_function_that_takes_a_system_has_been_judged():
    """A new one fails here until it is in a list of this page, with a call or a test of its own."""
    judged = {
        f"{function.__module__}.{function.__qualname__}"
        for calls in (cartpole_calls(Ramp()), spacecraft_calls(Spinner()))
        for function, _ in calls
    }
    found = set()
    for module in _theory():
        for name, value in vars(module).items():
            own = getattr(value, "__module__", None) == module.__name__ and not name.startswith("_")
            if not own or not callable(value):
                continue
            try:
                parameters = inspect.signature(value).parameters.values()
            except (TypeError, ValueError):
                continue
            kinds = ("System", "CartPole", "Spacecraft", "HeldControl")
            words = [str(p.annotation).replace("CartPoleQ", "").split(" ")[0] for p in parameters]
            takes = any(word in kinds for word in words)
            if takes or {p.name for p in parameters} & {"system", "body", "model"}:
                found.add(f"{module.__name__}.{name}")
    assert found == judged | {f"lagros_policies.{name}" for name in GENERAL}


def _theory():
    """Yield every module of the rooms of the theory and of the tasks."""
    for room in ("contraction", "proof", "remarks", "tasks"):
        package = importlib.import_module(f"lagros_policies.{room}")
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            yield importlib.import_module(module.name)

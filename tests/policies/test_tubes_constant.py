"""Tubes of constant metrics: the programs, the proof, and closed loops that try to leave."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from lagros_policies.contraction.cvstem import InfeasibleError
from lagros_policies.contraction.ellipsoid import TubeControl, _source, prove_tube
from lagros_policies.contraction.tube_design import (
    TubeDesign,
    design_constant,
    design_contained,
)
from lagros_policies.tasks.cartpole.plans import PlanBox

SMALL = PlanBox(angle=0.05, velocity=0.2, angular_rate=0.1, force=0.2)
ANGLE = (0.0, 1.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def ellipsoid(system):
    return design_contained(
        system, SMALL, TubeDesign(rate=0.8, output=ANGLE, disturbance_bound=0.05, floor=0.1)
    )


@pytest.fixture(scope="module")
def paper(system):
    return design_contained(
        system, SMALL, TubeDesign("paper", rate=0.8, disturbance_bound=0.02, control_penalty=0.01)
    )


def draw(tube, count, seed):
    """Return (x, x_d, u_d) with x_d in the plan's box and e anywhere in the box of errors."""
    rng = np.random.default_rng(seed)
    plan = tube.plan
    nominal = rng.uniform(-1, 1, (count, 4)) * [
        1.0,
        plan.angle,
        plan.velocity,
        plan.angular_rate,
    ]
    error = rng.uniform(-1, 1, (count, 4)) * np.maximum(tube.error, [1.0, 0, 0, 0])
    control = rng.uniform(-1, 1, (count, 1)) * plan.force
    return nominal + error, nominal, control


@pytest.mark.parametrize("name", ["ellipsoid", "paper"])
def test_the_condition_holds_on_the_box_by_the_definition_of_the_sdc_matrix(name, request, oracle):
    tube = request.getfixturevalue(name)
    state, nominal, control = draw(tube, 300, 0)
    slope, gain = oracle.sdc(state, nominal, control), oracle.input_matrix(state)
    product = slope @ tube.dual
    left = product + np.swapaxes(product, 1, 2) + 2 * tube.design.rate * tube.dual
    left = left - 2 * tube.control_weight * gain @ np.swapaxes(gain, 1, 2)
    source = 0.05**2 / (2 * 0.8) if name == "ellipsoid" else 0.0
    assert np.linalg.eigvalsh(left + source * np.eye(4)).max() < 0.0


def test_re_weighting_narrows_its_output_and_the_ellipsoid_narrows_everything(system):
    error = np.array([0.0, 0.2, 1.0, 1.0])
    design = TubeDesign("paper", rate=0.8, disturbance_bound=0.05, control_penalty=0.001)
    whole = design_constant(system, SMALL, error, design)
    angle = design_constant(system, SMALL, error, replace(design, method="output", output=ANGLE))
    assert angle.steady_outputs[1] < 0.9 * whole.steady_outputs[1]
    assert angle.steady_radius >= whole.steady_radius * (1 - 1e-6)
    kept = design_constant(
        system, SMALL, error, TubeDesign(rate=0.8, disturbance_bound=0.05, control_penalty=0.001)
    )
    assert kept.steady_radius < 0.5 * whole.steady_radius


def push_of(kind, rng, error, inverse, step, held):
    if kind == "steepest":
        pull = error @ inverse + 1e-12 * held[0]
        return pull / np.linalg.norm(pull, axis=1, keepdims=True)
    if kind == "constant":
        return held[0]
    return held[step // 40 % len(held)]


@pytest.mark.parametrize("kind", ["steepest", "constant", "switching"])
@pytest.mark.parametrize("name", ["ellipsoid", "paper"])
def test_no_disturbance_leaves_the_tube_at_any_time(name, kind, request, system, oracle):
    tube = request.getfixturevalue(name)
    rng = np.random.default_rng(4)
    count, fine, bound = 60, 0.004, tube.design.disturbance_bound
    nominal = rng.uniform(-0.5, 0.5, (count, 4)) * [1.0, 0.05, 0.2, 0.1]
    control = rng.uniform(-0.1, 0.1, (count, 1))
    law, inverse = TubeControl(system, tube), np.linalg.inv(tube.dual)
    held = rng.standard_normal((8, count, 4))
    held /= np.linalg.norm(held, axis=2, keepdims=True)
    state = nominal.copy()
    reached = 0.0
    for step in range(250):
        push = push_of(kind, rng, state - nominal, inverse, step, held)
        force = law(state, nominal, control)
        state = oracle.step(state, force, fine, 1, bound * push)
        nominal = oracle.step(nominal, control, fine, 1)
        if np.abs(nominal[:, 1]).max() > tube.plan.angle:
            break
        error = state - nominal
        allowed = tube.energy * tube.share((step + 1) * fine) ** 2
        energy = np.sum(error @ inverse * error, axis=1)
        assert np.all(energy <= allowed * (1 + 1e-3))
        reached = max(reached, float(np.max(energy) / allowed))
        for output in np.eye(4):
            bound_of_output = tube.output_radius(output, (step + 1) * fine)
            assert np.all(np.abs(error @ output) <= bound_of_output * (1 + 1e-3))
    # The test says something: some of the tube is used.
    assert reached > 0.05


def test_the_control_is_the_least_that_the_condition_allows(system, ellipsoid):
    state, nominal, control = draw(ellipsoid, 200, 2)
    law = TubeControl(system, ellipsoid)
    phi_0, phi_1 = law.terms(state, nominal, control)
    deviation = law(state, nominal, control) - control
    value = phi_0 + np.sum(phi_1 * deviation, axis=1)
    scale = np.abs(phi_0) + np.sum(np.abs(phi_1 * deviation), axis=1)
    assert np.all(value <= 1e-9 * scale)
    less = phi_0 + 0.99 * np.sum(phi_1 * deviation, axis=1)
    acts = np.abs(deviation[:, 0]) > 0
    assert acts.any()
    assert np.all(less[acts] > 0)


def test_a_tube_is_proved_and_spoiled_ones_are_not(system, ellipsoid):
    assert prove_tube(system, ellipsoid, 60.0).proved
    for spoiled in (
        # More of a disturbance than it was designed for.
        replace(ellipsoid, design=replace(ellipsoid.design, disturbance_bound=0.08)),
        # A tube that leaves the box of its condition.
        replace(ellipsoid, error=0.5 * ellipsoid.error),
        # No control.
        replace(ellipsoid, control_weight=1e-6),
    ):
        assert not prove_tube(system, spoiled, 1.0).proved


@pytest.mark.parametrize(("bound", "rate"), [(0.05, 0.8), (0.1, 0.3), (0.75, 0.7)])
def test_what_the_disturbance_adds_is_enclosed(bound, rate):
    found = _source(TubeDesign(rate=rate, disturbance_bound=bound))
    exactly = Fraction(bound) ** 2 / (2 * Fraction(rate))
    assert Fraction(float(found.lower)) <= exactly <= Fraction(float(found.upper))
    assert found.upper - found.lower < 1e-14
    assert _source(TubeDesign("paper", rate=rate, disturbance_bound=bound)) is None


@pytest.mark.parametrize("factor", [0.25, 4.0])
def test_the_bounds_of_theorem_1_do_not_depend_on_the_scale_of_the_metric(paper, factor):
    other = replace(paper, dual=factor * paper.dual)
    np.testing.assert_allclose(other.steady_outputs, paper.steady_outputs)
    assert other.steady_radius == pytest.approx(paper.steady_radius)


def test_a_disturbance_without_a_contained_tube_is_refused(system):
    with pytest.raises(InfeasibleError):
        design_contained(system, PlanBox(angle=0.8), TubeDesign(disturbance_bound=3.0))


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"rate": 0.0}, "rate=0"),
        ({"disturbance_bound": -1.0}, "disturbance_bound=-1"),
        ({"method": "output"}, "output=None"),
        ({"method": "paper", "output": ANGLE}, "must be None"),
        ({"margin": -0.1}, "margin=-0.1"),
    ],
)
def test_designs_out_of_range_are_refused(change, match):
    with pytest.raises(ValueError, match=match):
        replace(TubeDesign(), **change)

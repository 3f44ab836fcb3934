"""What an inspection computes, against formulas: reach of the controls, error of a hold, units."""

import math
from dataclasses import dataclass, field

import numpy as np
import pytest

from lagros_envs import find_task
from lagros_envs.task import Scenario, Task
from lagros_policies.inspection import Finding, count, motion, plans, verdict_of
from tests.policies.toys import Puck, Slide


def said(verdict):
    return Finding("one", verdict, "text")


@pytest.mark.parametrize(
    ("verdicts", "text"),
    [
        (["ok", "ok"], "boat is ready: nothing is wrong in 2 checks."),
        (["ok", "warning"], "boat flies, 1 warning."),
        (["warning", "ok", "warning"], "boat flies, 2 warnings."),
        (["fault"], "boat is NOT ready: 1 fault."),
        (["fault", "warning", "fault"], "boat is NOT ready: 2 faults, 1 warning."),
    ],
)
def test_the_verdict_is_one_sentence(verdicts, text):
    findings = [said(verdict) for verdict in verdicts]
    assert verdict_of("boat", findings) == text
    assert count(findings, "fault") == verdicts.count("fault")


def test_the_reach_is_that_of_the_reachability_matrix():
    """A mass in the plane: both axes alike, and [A^(N-1) B, ..., B] is known in closed form."""
    task = Slide(Puck(friction=0.0))
    found = plans.planned(task, 1, 0)
    (plan,) = found.plans
    reach, direction = plans._least_reach(task, plan)
    h, best = task.control_period, 0.0
    for window in {plan.horizon // share for share in (8, 4, 2, 1)}:
        left = np.arange(window)
        # A push of one for a step ends h^2 (left + 1/2) farther, and h faster.
        columns = task.control_scale[0] * np.stack([h * h * (left + 0.5), np.full(window, h)])
        best = max(best, math.sqrt(window) * np.linalg.svd(columns)[1][-1])
    assert reach == pytest.approx(best, rel=1e-6)
    assert np.linalg.norm(direction) == pytest.approx(1.0)


@dataclass(frozen=True)
class Decay:
    """One state that dies out, pushed."""

    rate: float = 1.0
    state_dim: int = 1
    control_dim: int = 1

    def derivative(self, state, control, functions):
        return (control[0] - self.rate * state[0],)


@dataclass(frozen=True)
class DecayTask(Task):
    """Bring it to zero."""

    system: Decay = field(default_factory=Decay)
    name, title = "decay", "Decay"

    def sample(self, rng):
        return Scenario(rng.uniform(-1.0, 1.0, 1), np.zeros(1))


@pytest.mark.parametrize(("rate", "verdict"), [(1.0, "ok"), (80.0, "warning"), (200.0, "fault")])
def test_a_hold_is_judged_by_the_growth_of_runge_kutta(rate, verdict):
    """In a quarter of a step, z = -rate h / 4, it multiplies by the Taylor polynomial of e^z."""
    task = DecayTask(Decay(rate))
    states, controls = np.array([[1.0]]), np.zeros((1, 1))
    z = -0.25 * rate * task.control_period
    polynomial = sum(z**power / math.factorial(power) for power in range(5))
    expected = abs(polynomial**4 - math.exp(4.0 * z))
    found = motion.of_hold(task, states, controls)
    assert found.verdict == verdict
    assert f"is off by up to {expected:.2g} of" in found.text


@pytest.mark.parametrize(
    ("names", "controls", "complaint"),
    [
        (("x [m]", "y [m]", "vx [m/s]", "vy [m/s]"), ("fx [N]", "fy [N]"), ""),
        (("x [m]", "y [m]", "vx [m s^-1]", "vy [m/s]"), ("fx [N]", "fy [N]"), ""),
        (("x [m]", "y [m]", "vx [mm/s]", "vy [m/s]"), ("fx [N]", "fy [N]"), "vx is in m/s"),
        (("x [-]", "y [rad]", "vx [1/s]", "vy [1/s]"), ("fx [N]", "fy [N]"), ""),
        (("x [m]", "y [m]", "vx [m/s]", "vy [m/s²]"), ("fx [N]", "fy [N]"), "vy is in m/s, and"),
        (("x [m]", "y [m]", "vx [m/s]", "vy [m/s]"), ("fx [m/s^2]", "fy [m/s]"), "m/s^2, and not"),
        (("x [deg]", "y [m]", "vx [m/s]", "vy [m/s]"), ("fx [N]", "fy [N]"), "in degrees"),
    ],
)
def test_units_are_held_against_what_is_the_rate_of_what(names, controls, complaint):
    named = type("Named", (Slide,), {"state_names": names, "control_names": controls})
    task = named(Puck(friction=0.0))
    rng = np.random.default_rng(0)
    states, pushes = rng.normal(size=(8, 4)), rng.normal(size=(8, 2))
    (found,) = motion.of_names(task, states, pushes)
    assert found.verdict == ("warning" if complaint else "ok")
    assert complaint in found.text


def test_states_are_drawn_about_the_ends_and_within_the_bounds_of_plans():
    task = find_task("pvtol")
    sample = [task.sample(np.random.default_rng(seed)) for seed in range(3)]
    states, controls = motion.drawn_places(task, sample, np.random.default_rng(1))
    assert states.shape == (192, 6)
    assert np.all(states >= task.state_low)
    assert np.all(states <= task.state_high)
    assert np.all((controls >= 0.0) & (controls <= 2.0 * task.system.hover))
    ends = np.array([[one.initial_state, one.goal] for one in sample]).reshape(-1, 6)
    assert np.all(np.abs(states - np.repeat(ends, 32, axis=0)) <= task.state_scale)

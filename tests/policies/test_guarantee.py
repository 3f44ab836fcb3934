"""Guarantees over tubes: against the rules of the environment at states drawn from the tubes."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest

from lagros_envs.dynamics import hold_step
from lagros_envs.numbers import Interval, functions
from lagros_envs.sweep import closest_approach
from lagros_envs.task import Scenario, Task
from lagros_envs.tasks.arm.task import ArmSettings
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_envs.tasks.pvtol.task import PvtolSettings
from lagros_envs.tasks.quadrotor.task import HeadingQuadrotorSettings
from lagros_policies.planning.planner import planner_of
from lagros_policies.proof.guarantee import guarantees, nominal_between

COUNT = 6


def planned(task, count=COUNT):
    """Return goals, discs, states and controls of plans."""
    rng, planner = np.random.default_rng(5), planner_of(task)
    found = []
    while len(found) < count:
        one = task.sample(rng)
        plan = planner.plan(one.initial_state, one.goal, discs=one.discs)
        if plan.solved:
            discs = np.zeros((task.most_discs, 3))
            discs[: len(one.discs)] = one.discs
            found.append((one.goal, discs, plan.states, plan.controls))
    return [np.stack(part) for part in zip(*found, strict=True)]


def tubes_of(task, states, sizes, directions=None, push=0.1):
    """Return tubes of boxes that grow with time, one size (n,) for each plan."""
    count, instants, n = states.shape
    directions = np.eye(n) if directions is None else directions
    box = np.linspace(0.0, 1.0, instants)[None, :, None] * sizes[:, None]
    outputs = box @ np.abs(directions).T
    return SimpleNamespace(
        closed=np.ones(count, bool),
        directions=directions,
        outputs=outputs,
        norm=np.linalg.norm(box, axis=-1),
        between=np.maximum(outputs[:, :-1], outputs[:, 1:]),
        deviation=np.full((count, instants - 1, task.system.control_dim), push),
        box=box,
    )


@pytest.fixture(scope="module", params=[CartPoleSettings(), PvtolSettings()], ids=lambda t: t.name)
def case(request):
    return request.param, planned(request.param)


def drawn_breaks(task, goals, discs, states, box, rng):
    """Return which plans fall, touch and miss at the corners of their boxes or within them."""
    fell, touched, missed = np.zeros((3, len(states)), bool)
    for _ in range(200):
        error = box * np.sign(rng.uniform(-1, 1, box.shape)) * rng.choice([1.0, 0.9, 0.3])
        flown = states + error
        parts = list(np.moveaxis(flown, -1, 0))
        fell |= task.fallen(parts, functions).any(axis=1)
        end = [part[:, -1] for part in parts]
        distance = task.goal_distance(end, list(goals.T), functions)
        missed |= distance > task.success_radius(task.time_limit)
        if discs.shape[1]:
            place = flown[..., list(task.position)]
            ends = np.stack([place[:, :-1], place[:, 1:]])[:, :, :, None] - discs[:, None, :, :2]
            gap = closest_approach(np.moveaxis(ends, -1, 1)) - discs[:, None, :, 2]
            there = discs[:, None, :, 2] > 0.0
            touched |= ((gap < task.body_radius) & there).any(axis=(1, 2))
    return fell, touched, missed


@pytest.mark.parametrize("scale", [0.05, 0.15, 0.3, 0.6, 1.0, 2.0])
def test_no_state_of_a_tube_breaks_what_is_guaranteed(case, scale):
    task, (goals, discs, states, controls) = case
    rng = np.random.default_rng(int(100 * scale))
    n = task.system.state_dim
    sizes = scale * rng.uniform(0.0, 1.0, (len(states), n))
    tubes = tubes_of(task, states, sizes)
    found = guarantees(task, goals, discs, states, controls, tubes)
    fell, touched, missed = drawn_breaks(task, goals, discs, states, tubes.box, rng)
    assert not np.any(found.upright & fell)
    assert not np.any(found.clear & touched)
    assert not np.any(found.reaches & missed)
    largest = np.abs(states).max(axis=1) + tubes.box.max(axis=1)
    assert np.all(found.state <= 1.1 * largest + 0.05)
    assert np.all(found.state >= np.abs(states).max(axis=1))


def test_small_tubes_are_guaranteed_and_large_ones_not(case):
    task, (goals, discs, states, controls) = case
    n = task.system.state_dim
    small = tubes_of(task, states, np.full((len(states), n), 1e-3), push=1e-3)
    assert guarantees(task, goals, discs, states, controls, small).holds.all()
    large = tubes_of(task, states, np.full((len(states), n), 3.0))
    found = guarantees(task, goals, discs, states, controls, large)
    assert not found.upright.any()
    assert not found.reaches.any()


@pytest.mark.parametrize(
    "task", [ArmSettings(), PvtolSettings(), HeadingQuadrotorSettings()], ids=lambda t: t.name
)
def test_the_distance_from_the_goal_is_bounded_closely_by_the_tasks_own_rule(task):
    # Around a goal the sum of squares under the root begins at zero.
    goals, discs, states, controls = planned(task, 2)
    box = np.full((2, task.system.state_dim), 0.01)
    # Wide where the distance does not look.
    box[:, -1] = 5.0 if task.name == "pvtol" else 0.01
    found = guarantees(task, goals, discs, states, controls, tubes_of(task, states, box))
    signs = np.sign(np.random.default_rng(1).uniform(-1.0, 1.0, (400, *box.shape)))
    ends = np.moveaxis(states[:, -1] + signs * box, -1, 0)
    flown = task.goal_distance(list(ends), list(goals.T), functions).max(axis=0)
    assert np.all(flown <= found.goal_distance)
    assert np.all(found.goal_distance <= 1.1 * flown)


def test_what_has_no_tube_has_no_guarantee_and_no_finite_bound(case):
    task, (goals, discs, states, controls) = case
    tubes = tubes_of(task, states, np.full((len(states), task.system.state_dim), 1e-3), push=1e-3)
    tubes.closed[0] = False
    tubes.outputs[0] = tubes.between[0] = tubes.norm[0] = tubes.deviation[0] = np.nan
    found = guarantees(task, goals, discs, states, controls, tubes)
    assert found.holds.tolist() == [False] + [True] * (len(states) - 1)
    assert np.isinf(found.state[0]).all()
    assert np.isinf(found.goal_distance[0])


def test_a_disc_that_only_some_error_touches_is_not_clear():
    """One disc beside a straight way: the guarantee ends where the tube meets it."""
    task = PvtolSettings()
    states, controls = np.zeros((1, 61, 6)), np.full((1, 60, 2), task.system.hover)
    states[0, :, 0] = np.linspace(0.0, 6.0, 61)
    discs = np.zeros((1, 5, 3))
    # The body passes at 0.1 m.
    discs[0, 0] = 3.0, 0.5 + task.body_radius + 0.1, 0.5
    for reach, clear in ((0.09, True), (0.11, False)):
        # Wide along the way, where nothing is met.
        box = np.array([[0.3, reach, 0.0, 0.0, 0.0, 0.0]])
        tubes = tubes_of(task, states, box, push=0.0)
        tubes.outputs[:] = tubes.between[:] = box[:, None]
        tubes.norm[:] = np.linalg.norm(box)
        found = guarantees(task, states[:, -1], discs, states, controls, tubes)
        # Half a metre beside the nearest point the disc is farther: only there the width matters.
        assert found.clear.tolist() == [clear]


def test_slanted_directions_part_what_a_box_does_not():
    """A disc off the corner of the box, which the body with its narrow slanted tube never meets."""
    task = PvtolSettings()
    states, controls = np.zeros((1, 61, 6)), np.full((1, 60, 2), task.system.hover)
    discs = np.zeros((1, 5, 3))
    contact = 0.5 + task.body_radius
    discs[0, 0] = *((contact + 0.2) * np.array([1.0, 1.0]) / np.sqrt(2.0)), 0.5
    slanted = np.zeros((1, 6))
    slanted[0, :2] = 1.0, 1.0
    box = np.array([[0.3, 0.3, 0.0, 0.0, 0.0, 0.0]])
    for directions, clear in ((None, False), (np.concatenate([np.eye(6), slanted]), True)):
        tubes = tubes_of(task, states, box, directions, push=0.0)
        tubes.norm[:] = np.linalg.norm(box)
        if directions is not None:
            # The errors of x and y are of opposite signs.
            tubes.outputs[..., -1] = 0.05
        found = guarantees(task, states[:, -1], discs, states, controls, tubes)
        assert found.clear.tolist() == [clear]


def test_controls_beyond_their_bounds_are_not_within(case):
    task, (goals, discs, states, controls) = case
    sizes = np.full((len(states), task.system.state_dim), 1e-3)
    tubes = tubes_of(task, states, sizes, push=100.0)
    found = guarantees(task, goals, discs, states, controls, tubes)
    bounded = np.isfinite(task.control_high).all()
    assert found.within.all() == (not bounded)


def test_a_motion_between_the_instants_is_enclosed_closely(case):
    task, (_, _, states, controls) = case
    period = task.control_period
    over = nominal_between(task.system, states, controls, period)
    shares = np.linspace(0.0, 1.0, 21)
    motion = np.stack(
        [
            hold_step(task.system, states[:, :-1], controls, share * period, substeps=8)
            for share in shares
        ]
    )
    # Room for the rounding of the motion itself.
    assert np.all((over.lower <= motion + 1e-12) & (motion - 1e-12 <= over.upper))
    spare = (over.upper - over.lower) - np.ptp(motion, axis=0)
    assert np.all(np.quantile(spare, 0.9, axis=(0, 1)) <= 0.05 * np.ptp(motion, axis=(0, 1, 2)))


@dataclass(frozen=True)
class Choosy(Task):
    """A body on a line that falls by rules of every kind that a task may write."""

    system: object = field(
        default_factory=lambda: SimpleNamespace(
            state_dim=2, control_dim=1, derivative=lambda x, u, f: (x[1], u[0])
        )
    )
    kind: str = "either"

    def sample(self, rng):
        return Scenario(np.zeros(2), np.zeros(2))

    def fallen(self, state, functions):
        from lagros_envs.numbers.functions import where

        if self.kind == "either":
            return (state[0] > 1.0) | (state[1] < -0.5)
        if self.kind == "both":
            return (state[0] > 1.0) & (state[1] <= 0.0)
        if self.kind == "chosen":
            return where(state[0] > 0.0, state[0] * 2.0, -1.0 * state[0]) > 1.0
        if self.kind == "branch":
            return state[0] > 1.0 if state[1] > 0.0 else state[0] > 2.0
        return state[0] > np.array(2.0)


@pytest.mark.parametrize("kind", ["either", "both", "chosen", "branch", "array"])
def test_rules_of_every_kind_are_evaluated_over_boxes(kind):
    task = Choosy(kind=kind)
    rng = np.random.default_rng(3)
    plans = 200
    states = np.repeat(rng.uniform(-1.5, 2.0, (plans, 1, 2)), 61, axis=1)
    controls = np.zeros((plans, 60, 1))
    sizes = rng.uniform(0.0, 0.5, (plans, 2))
    tubes = tubes_of(task, states, sizes)
    found = guarantees(task, states[:, -1], np.zeros((plans, 0, 3)), states, controls, tubes)
    if kind == "branch":
        # No interval can follow it: nothing is shown, and nothing raises.
        assert not found.upright.any()
        return
    corners = np.array([[a, b] for a in (-1.0, 0.0, 1.0) for b in (-1.0, 0.0, 1.0)])
    fell = np.zeros(plans, bool)
    for corner in corners:
        flown = states + tubes.box * corner
        fell |= np.asarray(task.fallen([flown[..., 0], flown[..., 1]], functions)).any(axis=1)
    # These rules are monotone between the corners, so that corners decide.
    assert np.array_equal(found.upright, ~fell)
    assert fell.any()
    assert not fell.all()


def test_a_comparison_of_intervals_says_what_can_and_what_must_be():
    one = Interval([0.0, 2.0, 0.5], [1.0, 3.0, 2.5])
    above = one > 1.5
    assert above.can.tolist() == [False, True, True]
    assert above.must.tolist() == [False, True, False]
    below = one <= 1.5
    assert below.can.tolist() == [True, False, True]
    assert below.must.tolist() == [True, False, False]
    chosen = above.where(Interval(10.0, 11.0), 0.0)
    assert chosen.lower.tolist() == [0.0, 10.0, 0.0]
    assert chosen.upper.tolist() == [0.0, 11.0, 11.0]
    with pytest.raises(TypeError, match="must not branch"):
        bool(above)

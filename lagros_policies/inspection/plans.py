"""What plans say of a task: whether there are any, what they ask for, what controls can move."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.dynamics import linearise_hold
from lagros_envs.seeding import episode_seeds, episode_streams
from lagros_envs.task import Scenario, Task
from lagros_policies.inspection.finding import Finding
from lagros_policies.inspection.motion import control_names, scales, state_names
from lagros_policies.planning import Trajectory
from lagros_policies.planning.planner import planner_of

# Namespace of the episodes ("insp" in ASCII): none is one of training or evaluation.
INSPECTION = 0x696E7370
_TOUCHED = 0.2  # share of steps at a limit from which feedback has too little room
# Actions of plans that are larger no learner has, and smaller ones are lost beside its own.
_LARGE_ACTION, _FINE_ACTION = 1.05, 0.02
# How far a direction can be moved in a plan, in scales: not at all, and hardly.
_UNMOVED, _WEAK = 1e-6, 0.05
_NAMED = 0.25  # entries of a direction that are named, as a share of the largest
_AT_LIMIT = 1e-6


class Planned(NamedTuple):
    """Random episodes with what their planner found.

    Attributes:
        seeds: Of the episodes.
        scenarios: Start, goal and discs of each.
        plans: A plan for each, which may not hold.
        seconds: How long each took [s].
    """

    seeds: Sequence[int]
    scenarios: Sequence[Scenario]
    plans: Sequence[Trajectory]
    seconds: Sequence[float]

    @property
    def held(self) -> list[int]:
        """Which have a plan that holds."""
        return [index for index, plan in enumerate(self.plans) if plan.solved]


def planned(task: Task, episodes: int, seed: int) -> Planned:
    """Draw episodes of a task and plan each."""
    seeds = episode_seeds(seed, episodes, INSPECTION)
    scenarios = [task.sample(episode_streams(one).scenario) for one in seeds]
    planner, plans, seconds = planner_of(task), [], []
    for one in scenarios:
        begun = time.perf_counter()
        plans.append(planner.plan(one.initial_state, one.goal, discs=one.discs))
        seconds.append(time.perf_counter() - begun)
    return Planned(seeds, scenarios, plans, seconds)


def of_planner(task: Task, found: Planned) -> Finding:
    """Count the plans that hold; say why the others do not."""
    held, count = len(found.held), len(found.plans)
    text = f"{held} of {count} random episodes have a plan"
    if held == count:
        return Finding("plans", "ok", f"{text}; median {1e3 * np.median(found.seconds):.0f} ms")
    worst = next(plan for plan in found.plans if not plan.solved)
    why = f'{text}; the others: "{worst.status}", defect {worst.defect:.2g}'
    if worst.clearance < 0.0:
        why += f", {-worst.clearance:.2g} m too near a disc"
    remedy = (
        "give more time (time_limit), wider limits (control_low, control_high, state_low, "
        "state_high), nearer goals or less margin; say in state_scale and control_spread how far "
        "each moves"
    )
    return Finding("plans", "warning" if held else "fault", why, remedy)


def of_limits(task: Task, found: Planned) -> list[Finding]:
    """Hold what plans use of the controls against their limits and scales."""
    controls = np.stack([found.plans[index].controls for index in found.held])
    low, high = np.array(task.control_low), np.array(task.control_high)
    spread = np.array(task.control_spread or (1.0,) * task.system.control_dim)
    touched = (controls <= low + _AT_LIMIT * spread) | (controls >= high - _AT_LIMIT * spread)
    share = touched.mean(axis=(0, 1))
    actions = np.abs(task.action(controls)).max(axis=(0, 1))
    names, findings = control_names(task), []
    for index, name in enumerate(names):
        used = f"plans use {controls[..., index].min():.3g} to {controls[..., index].max():.3g}"
        if share[index] > _TOUCHED:
            findings.append(
                Finding(
                    "limits",
                    "warning",
                    f"{name}: {used}, {100 * share[index]:.0f} % of the time at a limit, which "
                    "leaves feedback no room",
                    "widen control_low and control_high, or give more time (time_limit)",
                )
            )
        if actions[index] > _LARGE_ACTION or actions[index] < _FINE_ACTION:
            findings.append(
                Finding(
                    "limits",
                    "warning",
                    f"{name}: {used}, actions up to {actions[index]:.3g} in units of "
                    "control_scale; those of learners (ppo, sac) end at 1",
                    "set control_scale to about the largest change of u that the task needs",
                )
            )
    if findings:
        return findings
    largest = int(np.argmax(actions))
    text = f"plans use up to {100 * actions[largest]:.0f} % of control_scale ({names[largest]})"
    return [Finding("limits", "ok", text)]


def of_controllability(task: Task, found: Planned) -> Finding:
    """Look for a direction of the state that controls hardly move along plans.

    The Gramian of the linearisation along each plan says how far the end of the plan can be moved
    by changes of the control of the size of an action of one (root mean square). In each plan the
    direction that moves least is looked at; states count in scales. Where no plan holds, the first
    attempt at one is looked at, since this may be why.
    """
    reach, direction = min(
        (_least_reach(task, found.plans[index]) for index in found.held or [0]),
        key=lambda one: one[0],
    )
    entries = np.abs(direction) >= _NAMED * np.abs(direction).max()
    direction = direction * np.sign(direction[np.argmax(np.abs(direction))])
    pairs = zip(direction[entries], np.array(state_names(task))[entries], strict=True)
    named = " ".join(f"{value:+.2f} {name}" for value, name in pairs)
    if reach < _UNMOVED:
        return Finding(
            "controllability",
            "fault",
            f"along a plan no control moves {named}",
            "give it a control, or leave it out of the state; goals that ask for nothing of it "
            "need a goal_distance of the others, and a planner of their own",
        )
    text = f"the direction that moves least along a plan, {named}, moves by {reach:.2g} scales"
    if reach < _WEAK:
        return Finding(
            "controllability",
            "warning",
            f"{text} under actions of one",
            "give more time or control; or say in state_scale that it moves little. Disturbance in "
            "that direction stays",
        )
    return Finding("controllability", "ok", text)


def _least_reach(task: Task, plan: Trajectory) -> tuple[float, FloatArray]:
    """Return how far the direction that moves least moves, and which it is.

    Of several windows that end with the plan the best counts: over a long one the unstable motions
    of a body drown the others in rounding.
    """
    _, by_state, by_control = linearise_hold(
        task.system, plan.states[:-1], plan.controls, plan.period
    )
    scale = scales(task)
    columns: list[FloatArray] = []
    ahead = np.eye(len(scale))
    best = (-1.0, np.zeros(len(scale)))
    windows = {plan.horizon // share for share in (8, 4, 2, 1)} - {0}
    for step in range(plan.horizon - 1, -1, -1):
        moved = (ahead @ by_control[step]) * np.array(task.control_scale)
        columns.append(moved / scale[:, None])
        ahead = ahead @ by_state[step]
        if len(columns) in windows and np.all(np.isfinite(ahead)):
            left, values, _ = np.linalg.svd(np.concatenate(columns, axis=1))
            # Values that rounding makes of zero grow with the largest.
            values = np.resize(np.append(values, np.zeros(len(scale))), len(scale))
            least = max(float(values[-1]) - 1e-13 * float(values[0]), 0.0)
            reach = math.sqrt(len(columns)) * least
            if reach > best[0]:
                best = (reach, left[:, -1])
    return best

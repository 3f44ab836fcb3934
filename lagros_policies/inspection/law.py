"""Whether what is made of a task works: law along plans, regulator, metric, networks, proof."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from lagros_envs.env import TaskEnv
from lagros_envs.numbers import exact, functions
from lagros_envs.task import Scenario, Task
from lagros_policies.inspection.finding import Finding
from lagros_policies.inspection.plans import Planned

_KINDS = ("uniform", "constant")
_HALVINGS = 4
_ENOUGH = 0.75  # share of episodes that count as flown at a bound
_FELT = 0.01  # of the goal's radius: errors below are none
# Triples of the trial design; `lagros reproduce` takes 20,000, and searches for more.
_TRIPLES = 150


class Flight(NamedTuple):
    """How an episode went.

    Attributes:
        success: Whether the goal was reached.
        lost: Whether the body fell or collided.
        error: Largest distance from the plan.
    """

    success: bool
    lost: bool
    error: float


def of_regulator(task: Task) -> Finding:
    """Design the regulator about the goal, policy `lqr`."""
    from lagros_policies.baselines import LqrPolicy

    try:
        LqrPolicy(task)
    except ValueError as error:
        return Finding(
            "regulator",
            "warning",
            f"no regulator about the goal: {error}",
            "leave lqr out of defaults.policies; tube-mpc follows plans and needs none",
        )
    return Finding("regulator", "ok", "a regulator about the goal exists (policy lqr)")


def of_flights(task: Task, found: Planned) -> list[Finding]:
    """Fly the plans with the law along them (policy tube-mpc), calm and at the task's bound."""
    calm = _flown(task, found, "none", 0.0)
    if not all(one.success for one in calm):
        failed = next(one for one in calm if not one.success)
        how = "falls or collides" if failed.lost else "ends without success"
        return [
            Finding(
                "flights",
                "fault",
                f"without disturbance {_share(calm)} of the plans are flown to the goal; one "
                f"{how}, {failed.error:.2g} off its plan at most",
                "see that fallen, excess, goal_distance, goal_radius and state_low, state_high "
                "agree: a plan may go where the rules let nobody pass",
            )
        ]
    bound = task.defaults.bound
    at_bound = {kind: _flown(task, found, kind, bound) for kind in _KINDS}
    told = ", ".join(f"{_share(flights)} under {kind}" for kind, flights in at_bound.items())
    text = f"at d̄ = {bound:g}, the task's own, tube-mpc flies {told} disturbance"
    error = max(one.error for flights in at_bound.values() for one in flights)
    if min(_successes(flights) for flights in at_bound.values()) < _ENOUGH:
        return [Finding("disturbance", "warning", text, _smaller(task, found))]
    if error < _FELT * task.goal_radius:
        return [
            Finding(
                "disturbance",
                "warning",
                f"{text}; the largest error is {error:.2g}, so nothing is tested",
                "raise defaults.bound and defaults.bounds",
            )
        ]
    return [Finding("disturbance", "ok", f"{text}; largest error {error:.2g}")]


def of_metric(task: Task) -> Finding:
    """Ask CV-STEM for the metric that the task describes, on few triples: necessary, and quick."""
    from lagros_policies.contraction.cvstem import InfeasibleError, least_condition
    from lagros_policies.learning.metric import MetricSettings, described, metric_settings

    if task.metric is None or not isinstance(metric_settings(task), MetricSettings):
        text = "none is described: tube-mpc flies with that along each plan, and needs no other"
        return Finding("metric", "ok", text)
    where = "narrow low, high and error, lower the rate, or add functions to the basis"
    try:
        region, design = described(task)
        triples = region.sample(np.random.default_rng(0), _TRIPLES)
        least = least_condition(task.system, triples, region, design)
    except InfeasibleError as error:
        return Finding("metric", "fault", f"there is none as described: {error}", where)
    except RuntimeError as error:
        return Finding("metric", "warning", f"{error} (on {_TRIPLES} triples)", where)
    except ValueError as error:
        return Finding("metric", "fault", f"its description: {error}", where)
    except ImportError as error:
        return Finding("metric", "warning", f"not tried: {error}", "pip install 'lagros[train]'")
    text = (
        f"CV-STEM has one at {design.contraction_rate:g} 1/s on {_TRIPLES} triples, of condition "
        f"number {least:.3g} there; lagros reproduce designs it on all"
    )
    return Finding("metric", "ok", text)


def of_networks(task: Task) -> list[Finding]:
    """Build what networks see of an episode, if the task says that it has some."""
    from lagros_policies.learning.features import seen, view_of

    if task.learning is None:
        return []
    shown = TaskEnv(task=task).reset(seed=0)[0]
    try:
        view = view_of(task)
        features, _ = seen(view, shown)
    except Exception as error:
        return [
            Finding(
                "networks",
                "fault",
                f"features fail: {type(error).__name__}: {error}",
                "write them as a function of an observation's entries and of functions, like the "
                "equation",
            )
        ]
    if not np.all(np.isfinite(features)):
        place = int(np.argmin(np.isfinite(features)))
        text = f"feature {place} is {features[place]} at the start of an episode"
        return [Finding("networks", "fault", text, "look for a division by zero in features")]
    if task.learning.scheduled and not view.affine:
        return [
            Finding(
                "networks",
                "fault",
                "learning is scheduled, u = c + K x, and the features are not affine in the state",
                "let features begin with some that are affine in it, and not move with it after; "
                "or leave scheduled out",
            )
        ]
    return [Finding("networks", "ok", f"they see {len(features)} features")]


def of_proof(task: Task, scenario: Scenario) -> Finding:
    """Run the rules of the task on intervals, at a start, as `lagros certify` does."""
    box = [exact(np.array([part])) for part in scenario.initial_state]
    goal = [exact(np.array([part])) for part in scenario.goal]
    rules: dict[str, Callable[[], Any]] = {
        "fallen": lambda: task.fallen(box, functions),
        "goal_distance": lambda: task.goal_distance(box, goal, functions),
    }
    for name, rule in rules.items():
        try:
            rule()
        except Exception as error:
            return Finding(
                "proof",
                "warning",
                f"{name} does not run on intervals ({type(error).__name__}: {error}), so that "
                "lagros certify can show nothing of it",
                "use comparisons joined by & and |, and lagros_envs.numbers.functions.where in "
                "place of if",
            )
    return Finding("proof", "ok", "the rules run on intervals (lagros certify)")


def _flown(task: Task, found: Planned, kind: str, bound: float) -> list[Flight]:
    """Fly every plan that holds, in its own episode of the environment."""
    from lagros_policies.expert import Expert

    expert, flights = Expert(task), []
    env = TaskEnv(kind, bound, task=task) if kind != "none" else TaskEnv(task=task)
    for index in found.held:
        plan = found.plans[index]
        tracked = expert.track(plan.states[None], plan.controls[None])
        _, info = env.reset(seed=found.seeds[index], options={"nominal": plan.states})
        error, over, step = 0.0, False, 0
        while not over:
            control = expert.control(tracked, np.zeros(1, int), np.full(1, step), env.state[None])
            _, _, ended, truncated, info = env.step(task.action(control[0]).astype(np.float32))
            error = max(error, float(info["tracking_error"]))
            over, step = ended or truncated, step + 1
        lost = bool(info["fallen"] or info.get("collided", False))
        flights.append(Flight(bool(info["success"]), lost, error))
    return flights


def _smaller(task: Task, found: Planned) -> str:
    """Return what bound to take in place of one that is too large."""
    bound = task.defaults.bound
    for _ in range(_HALVINGS):
        bound *= 0.5
        flights = [_flown(task, found, kind, bound) for kind in _KINDS]
        if min(map(_successes, flights)) >= _ENOUGH:
            return (
                f"set defaults.bound and defaults.bounds to {bound:.2g}, where tube-mpc flies; or "
                "give feedback weights, or wider control limits"
            )
    return (
        f"no bound down to {bound:.2g} is flown: give feedback = Feedback(...), weights of states "
        "and controls, and see that limits leave it room"
    )


def _successes(flights: Sequence[Flight]) -> float:
    return sum(one.success for one in flights) / len(flights)


def _share(flights: Sequence[Flight]) -> str:
    return f"{sum(one.success for one in flights)} of {len(flights)}"

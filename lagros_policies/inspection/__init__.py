"""What is wrong with a task, beyond what registering it refuses: behind `lagros check`.

`lagros_envs.check_task` looks at shapes, names and kinds of number, and refuses. Here the task is
planned for, flown and designed for, on a few random episodes that are neither of training nor of
evaluation, and what is found is said in its author's words, each with a remedy.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lagros_envs.check_task import check_task
from lagros_envs.checks import check_whole
from lagros_envs.task import Task
from lagros_policies.inspection import law, motion, plans
from lagros_policies.inspection.finding import VERDICTS, Finding, Verdict, count, verdict_of

__all__ = ["VERDICTS", "Finding", "Verdict", "count", "inspect_task", "verdict_of"]


# Times that something is looked at where no fault is before it.
_LOOKS = 12


def inspect_task(
    task: Task,
    episodes: int = 8,
    seed: int = 0,
    tell: Callable[[str, int, int], None] = lambda *done: None,
) -> list[Finding]:
    """Look at a task of one body in every way in which it is used.

    Args:
        task: The task.
        episodes: Random episodes that are planned and flown.
        seed: Seed of them.
        tell: Called with what is being done, how often something was looked at, and how often in
            all.

    Returns:
        What was found, in the order in which it was looked at. Nothing is looked at that needs
        what a fault before it is about.
    """
    check_whole("episodes", episodes, 1, 1000)
    try:
        check_task(task)
    except (TypeError, ValueError) as error:
        return [refused(error)]
    looks: list[str] = []
    found = [Finding("description", "ok", "shapes, scenarios and the equation on all numbers")]

    def look(subject: str, at: Callable[[], Finding | list[Finding]]) -> None:
        """Add what one look has found; what raises in it is a fault of its own."""
        try:
            with np.errstate(all="ignore"):
                seen = at()
        except Exception as error:
            remedy = "correct what raises; if it is not in your file, please report it"
            text = f"{type(error).__name__}: {error}"
            seen = Finding(subject, "fault", text, remedy)
        found.extend(seen if isinstance(seen, list) else [seen])
        looks.append(subject)
        tell("looks", len(looks), _LOOKS)

    sample = [task.sample(np.random.default_rng([seed, index])) for index in range(episodes)]
    states, controls = motion.drawn_places(task, sample, np.random.default_rng(seed))
    look("names and units", lambda: motion.of_names(task, states, controls))
    look("energy", lambda: motion.of_energy(task, states))
    look("mirror", lambda: motion.of_mirror(task, states, controls))
    look("hold", lambda: motion.of_hold(task, states, controls))
    made = plans.Planned([], [], [], [])

    def plan() -> Finding:
        nonlocal made
        made = plans.planned(task, episodes, seed)
        return plans.of_planner(task, made)

    look("plans", plan)
    if made.plans:
        look("controllability", lambda: plans.of_controllability(task, made))
    if made.held:
        look("limits", lambda: plans.of_limits(task, made))
        look("disturbance", lambda: law.of_flights(task, made))
    look("regulator", lambda: law.of_regulator(task))
    look("metric", lambda: law.of_metric(task))
    look("networks", lambda: law.of_networks(task))
    look("proof", lambda: law.of_proof(task, sample[0]))
    return found


def refused(error: Exception) -> Finding:
    """Return the finding on a task that cannot be registered, or read at all."""
    return Finding("description", "fault", str(error), "correct this first; the rest follows it")

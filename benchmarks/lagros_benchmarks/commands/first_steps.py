"""What somebody sees first: what `lagros` alone prints, and the worlds of the demonstration."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lagros_benchmarks.run.settings import BenchmarkSettings

_STEPS = """lagros: robust learned motion planning with guarantees. Four things to try:

  lagros demo                          the paper's first experiment, a report to click through
  lagros watch {many} --seed 1     bodies that fly among obstacles
  lagros bench {one} --policies tube-mpc,lagros,lqr --disturbance constant
  lagros new mysystem.py               a system of your own, in a file that runs

All commands: lagros --help"""


def first_steps() -> str:
    """Return four things to try."""
    from lagros_envs.registry import first_task

    return _STEPS.format(one=first_task(), many=_first_world())


def a_few_worlds() -> BenchmarkSettings:
    """Return the short run of many bodies that ends the demonstration."""
    from lagros_benchmarks.run.settings import BenchmarkSettings
    from lagros_envs.registry import task_named

    world = _first_world()
    usual = task_named(world).defaults
    return BenchmarkSettings(
        task=world,
        policies=("lagros", "centralized"),
        bounds=(usual.bounds[1],),
        preset=usual.preset,
        agents=usual.agents,
        episodes=2,
        timing_episodes=1,
    )


def _first_world() -> str:
    """Return the first task of many bodies."""
    from lagros_envs.registry import task_named, task_names

    return next(name for name in task_names() if task_named(name).most_agents > 1)

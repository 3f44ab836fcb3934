"""Which rows carry a certified number: those whose flights a statement of ours is about."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

import lagros_policies
from lagros_benchmarks.report.records import summarise
from lagros_benchmarks.report.tables import csv_text
from lagros_benchmarks.run.runner import run_benchmark
from lagros_benchmarks.run.settings import BenchmarkSettings
from lagros_benchmarks.tasks.spacecraft.claims import position_margin, tracked_with_a_gain
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.contraction.double_integrator import certified_margin
from lagros_policies.remarks.lagrangian import steady_position_bound
from lagros_policies.tasks.spacecraft.centralized import CentralizedPolicy
from lagros_policies.tasks.spacecraft.safety_filter import SafetyFilter
from tests.benchmarks import fakes

CARTPOLE = ("learned", "lagros", "tube-mpc", "lqr", "ppo", "sac", "td3", "residual", "random")
SLIDING = "lagros_policies.tasks.spacecraft.sliding:SlidingCentralizedPolicy"


@pytest.mark.parametrize("channels", ["all", "rates"])
def test_no_policy_of_the_cartpole_is_given_a_certified_tube(channels: str) -> None:
    """Theorem 1 is for a control at will; every episode holds its control."""
    settings = BenchmarkSettings(
        policies=CARTPOLE, episodes=1, bounds=(0.05, 0.75), channels=channels
    )
    run = run_benchmark(settings)
    rows = summarise(run, ["lagros"])
    assert [row["policy"] for row in rows[: len(CARTPOLE)]] == list(CARTPOLE)
    for row in rows:
        assert row["certified_tube"] is None
        assert row["certified_violation_rate"] is None
        assert row["tube_violation_rate"] in (0.0, 1.0)
    assert all(r.left_certified_tube is None for records in run.episodes.values() for r in records)
    head, *lines = (line.split(",") for line in csv_text(rows).splitlines())
    place = head.index("certified_violation_rate")
    assert [line[place] for line in lines] == [""] * len(rows)


def world(**settings: Any) -> SpacecraftVectorEnv:
    given = SpacecraftSettings(**settings) if settings else None
    return SpacecraftVectorEnv(
        2, 2, "open", "uniform", 0.4, settings=given, autoreset_mode="disabled"
    )


def test_the_margin_is_that_of_the_centralised_laws() -> None:
    policy: Any = lagros_policies.make("centralized", world())
    assert position_margin(policy, 0.4) == policy.tracking.margin(0.4)
    least: Any = lagros_policies.make("centralized:least-norm", world())
    assert position_margin(least, 0.4) == certified_margin(least.tracking.plane, 0.4)
    assert tracked_with_a_gain(policy)
    assert not tracked_with_a_gain(least)
    sliding: Any = lagros_policies.make(SLIDING, world())
    assert position_margin(sliding, 0.4) == steady_position_bound(sliding.tracking.plane, 0.4)


class Derived(CentralizedPolicy):
    """Its `predict` could do anything."""


def test_what_applies_another_control_has_no_margin() -> None:
    env = world()
    bare: Any = lagros_policies.make("centralized", env)
    worn = SafetyFilter(bare, env.settings, env.preset, disturbance_bound=0.4)
    assert position_margin(worn, 0.4) is None
    assert position_margin(Derived(preset="open", num_agents=2), 0.4) is None
    limited = replace(SpacecraftSettings(), thrust_limit=0.5)
    assert position_margin(CentralizedPolicy(limited, "open", 2), 0.4) is None
    # It tracks too, but plans anew from where it is.
    assert position_margin(lagros_policies.make("tube-mpc", env), 0.4) is None
    for name in ("lagros", "learned", "ppo"):
        assert position_margin(lagros_policies.make(name, env), 0.4) is None
    assert position_margin(fakes.LinearPolicy(), 0.4) is None

"""The study of the general planner: its rows, and that its own check finds what is wrong."""

from dataclasses import replace

import numpy as np
import pytest
from studies.planner_general import CASES, checked, measure, show

from lagros_policies.planning import PlannerSettings, plan_trajectory


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_row_says_how_many_plans_hold_and_how_well(case, capsys):
    row = measure(case, 1, PlannerSettings())
    assert row["solved"] == row["episodes"] == 1
    assert row["defect_max"] < 1e-5
    assert row["own_defect_max"] < 1e-6
    assert row["clearance_min"] > -1e-5
    assert row["plan_cpu_ms"]["max"] > 0.0
    show([row])
    assert "1/1" in capsys.readouterr().out


def test_a_row_without_a_plan_is_a_row():
    hasty = PlannerSettings(attempts=1, scp=replace(PlannerSettings().scp, max_iterations=1))
    row = measure(CASES[0], 2, hasty)
    assert row["solved"] == 0
    assert sum(row["failed"].values()) == 2
    show([row])


def test_what_is_wrong_with_a_plan_is_found():
    case = CASES[0]
    problem = case.draw(np.random.default_rng(0))
    plan = plan_trajectory(problem)
    sound = checked(problem, plan, case.rates)
    assert max(sound["defect"], sound["bounds"], sound["end"]) < 1e-5
    moved = plan.states.copy()
    moved[20, :2] = problem.discs.centres[0]
    moved[30, 3] = 2.5
    moved[-1, 0] += 0.1
    found = checked(problem, replace(plan, states=moved), case.rates)
    assert found["defect"] > 0.1
    assert found["clearance"] < -0.5
    assert found["bounds"] == pytest.approx(0.5)
    assert found["end"] == pytest.approx(0.1)

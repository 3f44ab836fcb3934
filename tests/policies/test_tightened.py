"""Plans with the room of their own tube: what holds is flown clear, and what cannot is not said."""

from dataclasses import dataclass

import numpy as np
import pytest

from lagros_envs.task import Scenario
from lagros_policies.expert import Expert
from lagros_policies.proof.tightened import planned_with_tube
from tests.policies.plan_flights import flown, hostile
from tests.policies.toys import Slide


@dataclass(frozen=True)
class Close(Slide):
    """As `Slide`, with plans that graze the discs."""

    margin = 0.02


def scenario(task, seed):
    return task.sample(np.random.default_rng(seed))


def least_room(task, discs, ways):
    """Return the least distance of straight ways (f, N + 1, 2) from the discs beyond contact."""
    shares = np.linspace(0.0, 1.0, 21)[:, None, None, None]
    points = (1.0 - shares) * ways[:, :-1] + shares * ways[:, 1:]
    gaps = np.linalg.norm(points[..., None, :] - discs[:, :2], axis=-1) - discs[:, 2]
    return gaps.min() - task.body_radius


@pytest.mark.parametrize("seed", [0, 1])
def test_a_plan_with_the_room_of_its_tube_is_flown_clear_and_the_first_one_is_not(seed):
    task, bound = Close(), 0.15
    expert, asked = Expert(task), scenario(task, seed)
    first = planned_with_tube(expert, asked, bound, rounds=1)
    found = planned_with_tube(expert, asked, bound)
    assert not first.holds
    assert found.holds
    assert found.rounds > 1
    rng = np.random.default_rng(2)
    room = {}
    for name, one in (("first", first), ("found", found)):
        plan = one.plan.states, one.plan.controls
        gains = expert.track(plan[0][None], plan[1][None]).feedback[0]
        pushes = hostile(task.system, task.control_period, plan, gains, bound, rng, 40)
        limits = task.control_low, task.control_high
        errors = flown(task.system, task.control_period, plan, gains, pushes, limits)
        room[name] = least_room(task, asked.discs, (plan[0] + errors)[..., :2])
    assert room["first"] < 0.0 <= room["found"]


def test_where_nothing_is_in_the_way_one_plan_is_enough():
    task = Slide()
    asked = Scenario(np.zeros(4), np.array([4.0, 0.0, 0.0, 0.0]))
    found = planned_with_tube(Expert(task), asked, 0.05)
    assert found.holds
    assert found.rounds == 1


def test_what_leaves_no_room_does_not_hold_and_says_so():
    task = Close()
    found = planned_with_tube(Expert(task), scenario(task, 0), 2.0)
    assert not found.holds
    assert found.tubes.closed[0]


def test_a_law_that_is_no_gain_is_refused():
    task = Slide()

    class NoGain(Expert):
        def track(self, states, controls, first_step=0):
            plans = super().track(states, controls, first_step)
            return type(plans)(plans.states, plans.controls, plans.first_step)

    with pytest.raises(ValueError, match="no gain along the plan"):
        planned_with_tube(NoGain(task), scenario(task, 0), 0.1)

"""Which plans the states of a metric's design surround."""

from dataclasses import replace

import numpy as np

from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_policies.tasks.cartpole.metric_design import MetricDesignSettings, tube_samples
from lagros_policies.tasks.cartpole.planner import CartPolePlanner


def test_plans_that_failed_are_not_surrounded(monkeypatch):
    sound, asked = CartPolePlanner.plan, []
    # Out of the way in the position alone, which no region bounds.
    shift = np.array([100.0, 0.0, 0.0, 0.0])

    def plan(self, initial_state, goal):
        answer = sound(self, initial_state, goal)
        asked.append(answer)
        if len(asked) % 2:
            return answer
        return replace(answer, solved=False, states=answer.states + shift)

    monkeypatch.setattr(CartPolePlanner, "plan", plan)
    settings = MetricDesignSettings(plans=6, pool=1, checks=1)
    samples = tube_samples(settings, CartPoleSettings(), 1, 300)
    assert len(asked) == 6
    assert samples.nominal.shape == (300, 4)
    assert np.max(np.abs(samples.nominal[:, 0])) < 50.0

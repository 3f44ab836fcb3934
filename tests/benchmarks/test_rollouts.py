"""The studies' side-by-side flights against the vector environment, which counts for itself."""

from dataclasses import replace

import numpy as np
from studies.rollouts import fly, measures, plan_episodes

from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_envs.tasks.cartpole.vector import CartPoleVectorEnv
from lagros_policies.baselines import LqrPolicy
from lagros_policies.tasks.cartpole.expert import CartPoleExpert


def test_flights_and_measures_are_those_of_the_environment():
    expert = CartPoleExpert()
    episodes = plan_episodes(expert, 6, 992)
    # A system that is not the model, so that some episodes end badly.
    truth = CartPole(cart_mass=1.8)
    settings = replace(expert.task, system=truth)

    gain = LqrPolicy().gain.T

    def law(state, step):
        return episodes.controls[:, step] - (state - episodes.states[:, step]) @ gain

    flown = fly(episodes, law, truth, expert.task)
    env = CartPoleVectorEnv(6, settings=settings, autoreset_mode="disabled")
    _, info = env.reset(
        options={
            "initial_state": episodes.states[:, 0],
            "goal": episodes.goals,
            "nominal": episodes.states,
        },
        seed=0,
    )
    fell = np.zeros(6, bool)
    for step in range(settings.steps):
        # After a fall the environment moves on; what it said at the fall is kept.
        force = np.where(fell[:, None], 0.0, law(env.state, step))
        before = info
        _, _, _, _, info = env.step((force / settings.force_scale).astype(np.float32))
        if fell.any():
            for name in ("success", "effort_to_success"):
                info[name] = np.where(fell, before[name], info[name])
        fell |= info["fallen"]
    found = measures(episodes, flown, expert.task)
    assert found["success_rate"] == np.mean(info["success"])
    assert found["fall_rate"] == np.mean(fell)
    assert np.array_equal(flown.fallen, fell)
    assert 0 < fell.sum() < 6
    assert np.isclose(found["effort_mean"], np.mean(info["effort_to_success"]), rtol=1e-3)

"""From nothing to the cart-pole's metric: plans, samples of their tubes, CV-STEM, verification."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_fields, check_seed
from lagros_envs.seeding import episode_seeds, episode_streams
from lagros_envs.tasks.cartpole import task
from lagros_envs.tasks.cartpole.physics import ANGLE, ANGULAR_RATE
from lagros_policies.contraction import (
    CvStemSettings,
    Metric,
    Samples,
    design_on_pool,
    verify_metric,
)
from lagros_policies.contraction.regions import joined
from lagros_policies.tasks.cartpole.planner import CartPolePlanner
from lagros_policies.tasks.cartpole.region import Region

# Namespaces of episodes: the design, the check and the training data never share one.
_DESIGN = 1
_CHECK = 2
# Angle and force are largest in the first steps, where the condition binds.
_FIRST_STEPS = 15


@dataclass(frozen=True)
class MetricDesignSettings:
    """What to design and how to check it.

    Attributes:
        plans: Random episodes whose plans the states surround, for the design and for the check.
        pool: States that the design must satisfy.
        checks: Fresh states of the independent check.
        seed: Seed of all of them.
        cvstem: Rate, degree, weights.
        region: Where the metric must hold.

    Raises:
        ValueError: A number is not positive.
    """

    plans: int = 1000
    pool: int = 60_000
    checks: int = 10_000
    seed: int = 0
    cvstem: CvStemSettings = field(default_factory=lambda: CvStemSettings(scaling=Region.scaling))
    region: Region = field(default_factory=Region)

    def __post_init__(self) -> None:
        check_fields(self, least={"plans": 1, "pool": 1, "checks": 1})
        check_seed(self.seed)

    def design(self, task: task.CartPoleSettings) -> Metric:
        """Return the metric; see `design_cartpole_metric`."""
        return design_cartpole_metric(self, task)


def design_cartpole_metric(
    settings: MetricDesignSettings | None = None,
    task_settings: task.CartPoleSettings | None = None,
) -> Metric:
    """Design the cart-pole's metric and verify it on fresh states around fresh plans.

    Raises:
        InfeasibleError: No such metric exists.
        RuntimeError: The solver stopped, or the pool was not satisfied.
    """
    settings = settings or MetricDesignSettings()
    task_settings = task_settings or task.CartPoleSettings()
    pool = tube_samples(settings, task_settings, _DESIGN, settings.pool)
    metric = design_on_pool(task_settings.system, pool, settings.region, settings.cvstem)
    fresh = tube_samples(settings, task_settings, _CHECK, settings.checks)
    return verify_metric(task_settings.system, metric, fresh, settings.seed)


def tube_samples(
    settings: MetricDesignSettings,
    task_settings: task.CartPoleSettings,
    namespace: int,
    count: int,
) -> Samples:
    """Draw triples (x, x_d, u_d) of the region around the plans of random episodes."""
    planner = CartPolePlanner(task_settings)
    states, controls = [], []
    for seed in episode_seeds(settings.seed, settings.plans, namespace):
        scenario = task_settings.sample(episode_streams(seed).scenario)
        plan = planner.plan(scenario.initial_state, scenario.goal)
        if plan.solved:
            states.append(plan.states[:-1])
            controls.append(plan.controls)
    plan_states, plan_controls = np.stack(states), np.stack(controls)
    rng = np.random.default_rng([settings.seed, namespace])
    parts: list[Samples] = []
    kept = 0
    while kept < count:
        triples = _draw(rng, plan_states, plan_controls, settings.region, count)
        inside = settings.region.contains(triples.state, triples.nominal, triples.nominal_control)
        parts.append(triples.take(np.flatnonzero(inside)[: count - kept]))
        kept += len(parts[-1].state)
    return joined(*parts)


def _draw(
    rng: np.random.Generator,
    states: FloatArray,
    controls: FloatArray,
    region: Region,
    count: int,
) -> Samples:
    plans, steps = controls.shape[:2]
    plan = rng.integers(plans, size=count)
    early = rng.integers(min(_FIRST_STEPS, steps), size=count)
    step = np.where(rng.random(count) < 0.5, early, rng.integers(steps, size=count))
    nominal = states[plan, step]
    error = rng.uniform(-1.0, 1.0, size=(count, task.STATE_DIM))
    # The errors of position and velocity do not enter the condition; 1 m and 1 m/s will do.
    error[:, ANGLE] *= region.angle_error
    error[:, ANGULAR_RATE] *= region.angular_rate_error
    return Samples(nominal + error, nominal, controls[plan, step])

"""The remarks of the paper as policies of the cart-pole beside the others (`docs/extensions.md`).

None of them is in the tables of results, so that they are named by module and class:

    make("lagros_policies.tasks.cartpole.remarks:AdaptiveTubeMpcPolicy", env)
    lagros bench cartpole --policies lagros_policies.tasks.cartpole.remarks:NeuralTubeMpcPolicy
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lagros_envs.aliases import moved_names
from lagros_envs.arrays import BoolArray, Float32Array, FloatArray
from lagros_envs.conventions import settings_of
from lagros_envs.dynamics import System, vector_field
from lagros_envs.tasks.cartpole import task
from lagros_envs.tasks.cartpole.physics import VELOCITY
from lagros_policies.contraction.metric import ContractionMetric
from lagros_policies.observed import observed_rows
from lagros_policies.policy import PolicyState, row_memories
from lagros_policies.remarks.adaptive import (
    AdaptiveControl,
    Regressor,
    largest_gain,
)
from lagros_policies.tasks.cartpole.neural.metric import load_neural_metric
from lagros_policies.tasks.cartpole.systems import check_cartpole
from lagros_policies.tube_mpc import TubeMpcPolicy, TubeMpcState, check_own_metric

moved_names(__name__)

# What the adaptation is prepared for: |dp/dt| [m/s] and |d2p/dt2| [m/s^2] of the cart, and how far
# its friction [N s/m] and its mass [kg] may be from the model's.
_REACH = (1.5, 8.0)
_LIMITS = (3.0, 0.8)
_LEAKAGE = 0.02  # [1/s]


def friction_regressor(state: FloatArray, control: FloatArray) -> FloatArray:
    """Return Y = -dp/dt, shape (..., 1): a is the true friction less the model's [N s/m].

    Raises:
        ValueError: The states are not of the cart-pole's four.
    """
    if np.shape(state)[-1:] != (4,):
        raise ValueError(f"state of shape {np.shape(state)} must be the cart-pole's, (..., 4)")
    return -state[..., VELOCITY, None]


def cart_mass_regressor(model: System) -> Regressor:
    """Return Y = -d2p/dt2 of the model: a is the true mass of the cart less the model's [kg].

    The equation of the cart reads (m_c + m) d2p/dt2 + ... = u, so that more mass is a force against
    the acceleration. Y takes the model's acceleration for the true one, which is right to first
    order in a.

    Raises:
        TypeError: The model is no cart-pole.
    """
    check_cartpole(model, "cart_mass_regressor")

    def regressor(state: FloatArray, control: FloatArray) -> FloatArray:
        return -vector_field(model, state, control)[..., VELOCITY, None]

    return regressor


class NeuralTubeMpcPolicy(TubeMpcPolicy):
    """Online tube MPC whose u* contracts in a metric that is a network.

    Args:
        settings: The task.
        metric: File of `save_neural_metric`; the shipped network if left out.
        allow_other_settings: As in `TubeMpcPolicy`.
        planning: As in `TubeMpcPolicy`: `replan_every`, `deadline` and `clock`.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is not such a metric, or a number is out of range.
    """

    name = "neural-tube-mpc"

    def __init__(
        self,
        settings: task.CartPoleSettings | None = None,
        metric: str | Path | None = None,
        allow_other_settings: bool = False,
        **planning: Any,
    ) -> None:
        if metric is None:
            check_own_metric(settings_of(task.CartPoleSettings(), settings), allow_other_settings)
        super().__init__(settings, load_neural_metric(metric), **planning)


@dataclass
class AdaptiveState(TubeMpcState):
    """What the adaptive policy remembers of one episode, beside its plans.

    Attributes:
        estimate: a_hat: friction [N s/m] and mass [kg] of the cart, less the model's.
        step: Control step of the last call; -1 before the first.
        state: x at that step, shape (4,).
        wanted: u* at that step, shape (1,) [N].
    """

    estimate: FloatArray = field(default_factory=lambda: np.zeros(2))
    step: int = -1
    state: FloatArray = field(default_factory=lambda: np.zeros(task.STATE_DIM))
    wanted: FloatArray = field(default_factory=lambda: np.zeros(1))


def _friction_and_mass(model: System, state: FloatArray, control: FloatArray) -> FloatArray:
    """Return Y for both unknowns, shape (..., 1, 2)."""
    parts = friction_regressor(state, control), cart_mass_regressor(model)(state, control)
    return np.concatenate(parts, axis=-1)


class AdaptiveTubeMpcPolicy(TubeMpcPolicy):
    """Online tube MPC that finds a wrong friction or mass of the cart while it flies (aNCM).

    The force is u* - Y a_hat; from one call to the next a_hat moves as `AdaptiveControl.update`
    says. The estimate belongs to an episode and starts at zero.

    Args:
        settings: The task, with the system that the policy *believes* in.
        metric: The contraction metric, or its file; the shipped one if left out.
        planning: All else that `TubeMpcPolicy` takes.

    Raises:
        ValueError: A number is out of range.
    """

    name = "adaptive-tube-mpc"

    def __init__(
        self,
        settings: task.CartPoleSettings | None = None,
        metric: ContractionMetric | str | Path | None = None,
        **planning: Any,
    ) -> None:
        super().__init__(settings, metric, **{"law": "tuned", **planning})
        self.name = type(self).name
        law = self.expert.law
        # A function of the module, so that the policy can be pickled.
        regressor = partial(_friction_and_mass, law.system)
        gain = largest_gain(law, _REACH)
        self.adaptive = AdaptiveControl(law, regressor, gain, _LEAKAGE, _LIMITS)

    def predict(
        self,
        observation: Float32Array,
        state: PolicyState = None,
        episode_start: BoolArray | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, PolicyState]:
        """Plan, learn and track; see `Policy.predict`. The state is one per row."""
        count = len(np.atleast_2d(observed_rows(observation, task.OBSERVATION_DIM, np.float64)))
        memories = row_memories(state, episode_start, count, "episodes", AdaptiveState)
        fresh = [AdaptiveState() if memory is None else memory for memory in memories]
        return super().predict(observation, fresh, None, deterministic)

    def _control(self, row: FloatArray, memory: Any) -> FloatArray:
        wanted = super()._control(row, memory)
        if memory.tracked is None:
            return wanted
        state = row[task.STATE]
        step = round(float(row[task.TIME]) / self.settings.control_period)
        if 0 <= memory.step == step - 1 < self.settings.steps - 1:
            nominal = memory.tracked.states[0, step - memory.tracked.first_step]
            memory.estimate = self.adaptive.update(
                memory.estimate, memory.state, memory.wanted, state, nominal
            )
        memory.step, memory.state, memory.wanted = step, state.copy(), wanted
        return self.adaptive.corrected(state, wanted, memory.estimate)

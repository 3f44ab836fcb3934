"""Find the weights of the feedback that u* prefers (lagros_policies/tasks/cartpole/feedback.py).

Minimises, by gradient descent through simulated episodes, the share of episodes whose error leaves
the published tube under the uniform disturbance of bound 0.75. An episode is a plan of a random
scenario, flown for the first seconds, in which the tube is narrow, with the two linear-quadratic
gains and the gate between them; the gains come from the same backward Riccati recursion, the
motion from the system's own `derivative`, both in torch. The exit "max over time of error/radius
exceeds one" is smoothed by a soft maximum and a sigmoid that narrows as the search goes on, and a
small weight on the effort of the corrections settles the rest. Adam, two stages:

1. the tight gain alone, from constant weights (`STARTING`);
2. both gains and the gate, the gentle gain starting as the tight one with a dearer control early.

The search knows nothing of the contracting interval that clips the preferred v. Therefore every
set of weights is judged at the end by the real expert, on fresh plans and disturbances, over whole
episodes: the least-norm u* (v = 0 preferred), the starting weights, the found weights rounded to
two decimals, as they are written to the JSON file, and the shipped weights.

    OMP_NUM_THREADS=1 python benchmarks/tuning/feedback.py [--seed 0] [--json FILE]
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from lagros_benchmarks.report.records import versions
from lagros_benchmarks.run.files import write_json
from lagros_envs.disturbances import OPEN_LOOP
from lagros_envs.dynamics import hold_step, linearise_hold
from lagros_envs.dynamics.integrate import rk4_hold
from lagros_envs.seeding import episode_seeds, episode_streams
from lagros_envs.tasks.cartpole import task
from lagros_policies.contraction.feedback import _TERMINAL_WEIGHT
from lagros_policies.tasks.cartpole.expert import CartPoleExpert
from lagros_policies.tasks.cartpole.feedback import FeedbackSettings, WeightSchedule

FloatArray = NDArray[np.float64]
Weights = dict[str, torch.Tensor]

# Namespaces of episodes: the search and the judgement share none with each other or anyone else.
_SEARCH = 0x74756E65
_FRESH = 0x66726573
_BOUND = 0.75
# Nearly all exits happen in the first seconds, where the tube is narrow. Only these steps are
# flown; gains are differentiated from a few seconds later on backwards.
_HORIZON = 26
_RICCATI_STEPS = 45
_SOFTNESS = 0.04  # of the maximum over time of error/radius
_EFFORT_WEIGHT = 1e-3  # share of exits that one N^2 s of corrections is worth
_RATE = 0.08  # of Adam at first; it falls to a twentieth
_BATCH, _REPEATS = 256, 3  # plans of a descent step, disturbances of each plan
# The gentle gain starts as the tight one with this added to the control's log-weights.
_DEARER = (0.0, 2.0, 0.0, 0.0)

# Constant weights: every state counts alike, the control e^-3 as much. The gate's numbers leave the
# gain tight until a step is foreseen to end near the tube's edge.
_CONSTANT = WeightSchedule(state=((0.0,) * 4,) * 4, control=(-3.0, 0.0, 0.0, 0.0))
STARTING = FeedbackSettings(_CONSTANT, _CONSTANT, gate_offset=-3.0, gate_slope=4.0)


class Plans(NamedTuple):
    """x_d (p, N + 1, 4), u_d (p, N), A (p, N, 4, 4) and B (p, N, 4, 1) of the plans."""

    states: torch.Tensor
    controls: torch.Tensor
    by_state: torch.Tensor
    by_control: torch.Tensor


def plan_episodes(
    expert: CartPoleExpert, count: int, seed: int, namespace: int
) -> tuple[FloatArray, FloatArray]:
    """Plan random episodes: x_d, shape (count, N + 1, 4), and u_d, (count, N, 1)."""
    plans = []
    for one in episode_seeds(seed, count, namespace):
        scenario = expert.task.sample(episode_streams(one).scenario)
        plan = expert.planner.plan(scenario.initial_state, scenario.goal)
        if not plan.solved:
            raise RuntimeError(f"episode {one} has no plan: {plan.status}")
        plans.append(plan)
    return np.stack([plan.states for plan in plans]), np.stack([plan.controls for plan in plans])


def pushes(rng: np.random.Generator, shape: tuple[int, ...], period: float) -> FloatArray:
    """Draw uniform disturbances of the bound, shape (*shape, 4)."""
    drawn = OPEN_LOOP["uniform"].realise(rng, int(np.prod(shape)), task.STATE_DIM, period)
    return _BOUND * drawn.reshape(*shape, task.STATE_DIM)


class ClosedLoop:
    """The preferred feedback and the motion under it, in torch, for batches of plans."""

    def __init__(self, task_settings: task.CartPoleSettings) -> None:
        """Tabulate the schedules' basis, the tube and the gate's decay."""
        self.task = task_settings
        times = task_settings.control_period * np.arange(task_settings.steps + 1)
        exponents = np.arange(len(STARTING.tight.control)) * times[:, None]
        self.basis = torch.tensor(np.exp(-exponents / STARTING.tight.decay_time))
        radii = STARTING.tube.radius(times)
        radii[0] = radii[1]
        self.radii = torch.tensor(radii)
        self.decay = torch.tensor(np.exp(-STARTING.tube.contraction_rate * times))

    def gains(self, weights: Weights, plans: Plans) -> torch.Tensor:
        """Return K of the g gains, shape (g, p, _RICCATI_STEPS, 4)."""
        state = torch.exp(torch.einsum("tj,gji->gti", self.basis, weights["state"]))
        control = torch.exp(torch.einsum("tj,gj->gt", self.basis, weights["control"]))
        diagonal = torch.diag_embed(state)[:, :, None]
        value = _TERMINAL_WEIGHT * diagonal[:, -1]
        gains: list[torch.Tensor] = []
        for step in range(self.task.steps - 1, -1, -1):
            with torch.set_grad_enabled(step < _RICCATI_STEPS):
                slope, push = plans.by_state[:, step], plans.by_control[:, step]
                strain = value @ push
                pull = strain.mT @ slope
                gain = pull / (control[:, step, None, None, None] + push.mT @ strain)
                value = diagonal[:, step] + slope.mT @ (value @ slope) - pull.mT @ gain
                value = 0.5 * (value + value.mT)  # rounding errors would grow
            if step < _RICCATI_STEPS:
                gains.append(gain[..., 0, :])
        return torch.stack(gains[::-1], dim=2)

    def foresight(self, tight: torch.Tensor, plans: Plans) -> torch.Tensor:
        """Return maps from e to the foreseen e/radius, shape (p, _HORIZON, 1 + lookahead, 4, 4)."""
        steps = tight.shape[1]
        closed = plans.by_state[:, :steps] - plans.by_control[:, :steps] * tight[..., None, :]
        product = torch.eye(task.STATE_DIM, dtype=closed.dtype).expand(closed[:, :_HORIZON].shape)
        maps = []
        for ahead in range(STARTING.lookahead + 1):
            if ahead:
                product = closed[:, ahead - 1 : ahead - 1 + _HORIZON] @ product
            maps.append(product / self.radii[ahead : ahead + _HORIZON, None, None])
        return torch.stack(maps, dim=2)

    def fly(
        self, weights: Weights, plans: Plans, pushed: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return error/radius and v of every step, (_HORIZON, s, p), under pushes (s, p, k, 4)."""
        period, sharpness = self.task.control_period, STARTING.sharpness
        gains, gate = self.gains(weights, plans), weights.get("gate")
        maps = None if gate is None else self.foresight(gains[0], plans)
        error = torch.zeros_like(pushed[:, :, 0])
        state = list((plans.states[:, 0] + error).unbind(-1))
        ratios, deviations = [], []
        for step in range(_HORIZON):
            deviation = -(gains[0, :, step] * error).sum(-1)
            if gate is not None and maps is not None:
                gentle = -(gains[1, :, step] * error).sum(-1)
                foreseen = torch.einsum("paij,spj->spai", maps[:, step], error)
                # The error is zero at the start, where a norm has no gradient.
                norms = torch.sqrt(foreseen.square().sum(-1) + 1e-12)
                soft = torch.logsumexp(sharpness * norms, -1) / sharpness
                share = self.decay[step] * torch.sigmoid(gate[0] + gate[1] * soft)
                deviation = deviation + share * (gentle - deviation)
            force = plans.controls[:, step] + deviation
            push = pushed[:, :, step].unbind(-1)
            state = list(rk4_hold(self.task.system, state, [force], push, period, torch, 1))
            error = torch.stack(state, -1) - plans.states[:, step + 1]
            ratios.append(error.norm(dim=-1) / self.radii[step + 1])
            deviations.append(deviation)
        return torch.stack(ratios), torch.stack(deviations)


def as_settings(weights: Weights) -> FeedbackSettings:
    """Return settings of searched weights, rounded to two decimals."""
    state, control = (np.round(weights[name].numpy(), 2).tolist() for name in ("state", "control"))
    tight, gentle = (
        WeightSchedule(tuple(map(tuple, rows)), tuple(row))
        for rows, row in zip(state, control, strict=True)
    )
    return FeedbackSettings(tight, gentle, *np.round(weights["gate"].numpy(), 2).tolist())


def descend(loop: ClosedLoop, start: Weights, plans: Plans, steps: int, seed: int) -> Weights:
    """Run one stage of the search, with a gate if the weights have one, and return its weights."""
    console, started, exits = Console(), time.perf_counter(), 0.0
    stage = "both gains" if "gate" in start else "tight gain"
    rng = np.random.default_rng([seed, _SEARCH, len(start)])
    weights = {name: value.clone().requires_grad_() for name, value in start.items()}
    adam = torch.optim.Adam(weights.values())
    period = loop.task.control_period
    for step in range(steps):
        left = 1.0 - step / steps
        adam.param_groups[0]["lr"] = _RATE * (left + 0.05)
        chosen = torch.tensor(rng.integers(len(plans.states), size=_BATCH))
        batch = Plans(*(part[chosen] for part in plans))
        pushed = torch.tensor(pushes(rng, (_REPEATS, _BATCH, _HORIZON), period))
        ratios, deviations = loop.fly(weights, batch, pushed)
        worst = torch.logsumexp(ratios / _SOFTNESS, 0) * _SOFTNESS
        smooth_exits = torch.sigmoid((worst - 1.0) / (0.12 * left + 0.045)).mean()
        effort = period * deviations.square().sum(0).mean()
        adam.zero_grad()
        torch.autograd.backward(smooth_exits + _EFFORT_WEIGHT * effort)
        torch.nn.utils.clip_grad_norm_(weights.values(), 1.0)
        adam.step()
        exits += (ratios > 1.0).any(0).double().mean().item()
        if (step + 1) % 100 == 0:
            console.print(
                f"{stage}, step {step + 1} of {steps}: {exits:.1f} % left the tube, "
                f"effort of v {effort.item():.1f}, {time.perf_counter() - started:.0f} s"
            )
            exits = 0.0
    return {name: value.detach() for name, value in weights.items()}


def search(expert: CartPoleExpert, options: argparse.Namespace) -> FeedbackSettings:
    """Run both stages and return the found weights."""
    states, controls = plan_episodes(expert, options.plans, options.seed, _SEARCH)
    loop, period = ClosedLoop(expert.task), expert.task.control_period
    _, by_state, by_control = linearise_hold(loop.task.system, states[:, :-1], controls, period)
    plans = Plans(*map(torch.tensor, (states, controls[..., 0], by_state, by_control)))
    # A leading axis for the gains: one in the first stage, two in the second.
    start = {
        "state": torch.tensor([STARTING.tight.state], dtype=torch.float64),
        "control": torch.tensor([STARTING.tight.control], dtype=torch.float64),
    }
    tight = descend(loop, start, plans, options.tight_steps, options.seed)
    dearer = torch.tensor([[0.0] * len(_DEARER), _DEARER], dtype=torch.float64)
    start = {
        "state": tight["state"].repeat(2, 1, 1),
        "control": tight["control"] + dearer,
        "gate": torch.tensor([STARTING.gate_offset, STARTING.gate_slope], dtype=torch.float64),
    }
    return as_settings(descend(loop, start, plans, options.both_steps, options.seed))


def judge(
    expert: CartPoleExpert, planned: tuple[FloatArray, FloatArray], pushed: FloatArray, prefer: bool
) -> dict[str, float]:
    """Fly whole episodes with the real expert; count exits and final states at the goal."""
    settings, period = expert.task, expert.task.control_period
    plans = expert.track(*planned)
    everyone = np.arange(len(plans.states))
    state, effort = plans.states[:, 0], 0.0
    left, fallen = np.zeros((2, len(state)), dtype=bool)
    for step in range(settings.steps):
        if prefer:
            force = expert.control(plans, everyone, np.full(len(everyone), step), state)
        else:
            force = expert.law(state, plans.states[:, step], plans.controls[:, step])
        state = hold_step(settings.system, state, force, period, pushed[:, step])
        # A pole that has fallen long ago may overflow; it is counted as fallen.
        state = np.where(np.isfinite(state) & (np.abs(state) < 1e3), state, 1e3)
        error = np.linalg.norm(state - plans.states[:, step + 1], axis=-1)
        inside = error <= settings.tube.radius(period * (step + 1)) + 1e-6
        fallen |= np.abs(state[:, 1]) > task.FALL_ANGLE
        left |= fallen | ~inside
        effort += period * float(np.mean(np.square(force)))
    return {
        "left_tube": float(np.mean(left)),
        "success": float(np.mean(inside & ~fallen)),
        "effort": effort,
        "plan_effort": period * settings.steps * float(np.mean(np.square(plans.controls))),
    }


def main() -> None:
    """Search, judge and write from the command line."""
    parser = argparse.ArgumentParser(description="Find the weights of the preferred feedback.")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--plans", type=int, default=600, help="plans of the search")
    parser.add_argument("--tight-steps", type=int, default=300)
    parser.add_argument("--both-steps", type=int, default=1800)
    parser.add_argument("--fresh", type=int, default=1000, help="plans of the judgement")
    parser.add_argument("--json", type=Path, default=Path("benchmarks/results/feedback.json"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    expert = CartPoleExpert(law="tuned")
    found = search(expert, options)
    seconds = time.process_time()

    planned = plan_episodes(expert, options.fresh, options.seed, _FRESH)
    states, controls = (np.repeat(array, _REPEATS, axis=0) for array in planned)
    rng, shape = np.random.default_rng([options.seed, _FRESH]), controls.shape[:2]
    pushed = pushes(rng, shape, expert.task.control_period)
    table = Table("preferred v", "left the tube", "success", "effort", "effort of the plans")
    results: dict[str, dict[str, float]] = {}
    laws = {"0 (least norm)": None, "starting": STARTING, "found": found}
    for name, settings in {**laws, "shipped": FeedbackSettings()}.items():
        judged = CartPoleExpert(feedback=settings)
        results[name] = row = judge(judged, (states, controls), pushed, settings is not None)
        table.add_row(name, *(f"{row[key]:.4g}" for key in row))
    Console().print(table)
    record: dict[str, object] = {"command": ["python", *sys.argv], "versions": versions()}
    record |= {"results": results, "weights": asdict(found)}
    Console().print(f"search: {seconds:.0f} s of CPU time; {write_json(options.json, record)}")


if __name__ == "__main__":
    main()

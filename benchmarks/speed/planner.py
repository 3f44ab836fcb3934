"""Planning: cold and warm plans against CasADi, the quadratic programs alone, the share solved."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from speed import qp_solvers
from speed.report import Row, Section, Target, absent_row, timed_row
from speed.timing import Candidate, Scale, Times, interleave

from lagros_envs import cartpole_task as task
from lagros_envs.seeding import episode_seeds, episode_streams
from lagros_policies.planning import (
    CartPolePlanner,
    CartPolePlannerSettings,
    ScpSettings,
    Trajectory,
)
from lagros_policies.planning.qp import QpSolution, QuadraticProgram, solve_qp, solve_with_clarabel

if TYPE_CHECKING:
    from speed.casadi_peer import Answer, CasadiPlanner

FloatArray = NDArray[np.float64]

# Episodes of these benchmarks, apart from those of training and of evaluation.
_EPISODES = 0x73706565
# What a disturbance of d_bar = 0.75 can move a state by in one control period of 0.1 s.
_PERTURBATION = 0.075
_SEED = 0


def sections(scale: Scale) -> list[Section]:
    """Measure and return the tables."""
    bench = _Bench.prepare(scale)
    return [_cold(bench), _warm(bench), _programs(bench), _slopes(bench), _share(bench)]


@dataclass(frozen=True)
class _Bench:
    """The planner and the episodes, with their cold plans."""

    scale: Scale
    planner: CartPolePlanner
    scenarios: list[task.CartPoleScenario]
    plans: list[Trajectory]
    perturbed: FloatArray  # x_d(1) moved by one period of disturbance, (episodes, 4)

    @classmethod
    def prepare(cls, scale: Scale) -> _Bench:
        settings = task.CartPoleSettings(time_limit=0.1 * scale.steps)
        planner = CartPolePlanner(settings)
        scenarios = _draw(settings, scale.plans)
        plans = [planner.plan(one.initial_state, one.goal) for one in scenarios]
        direction = np.random.default_rng(_SEED).standard_normal((len(plans), task.STATE_DIM))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        perturbed = np.stack([plan.states[1] for plan in plans]) + _PERTURBATION * direction
        return cls(scale, planner, scenarios, plans, perturbed)

    def peers(self, start_step: int, warm: bool) -> dict[str, CasadiPlanner]:
        """Build the CasADi solvers that are installed."""
        if importlib.util.find_spec("casadi") is None:
            return {}
        from speed.casadi_peer import CasadiPlanner, available

        names = {"CasADi + IPOPT": "ipopt", "CasADi + fatrop": "fatrop"}
        return {
            label: CasadiPlanner(self.planner, solver, start_step, warm)
            for label, solver in names.items()
            if available(solver)
        }

    def cold_plan(self, index: int) -> Trajectory:
        """Plan an episode from a straight line."""
        scenario = self.scenarios[index]
        return self.planner.plan(scenario.initial_state, scenario.goal)


def _draw(settings: task.CartPoleSettings, count: int) -> list[task.CartPoleScenario]:
    return [
        task.sample_scenario(episode_streams(seed).scenario, settings)
        for seed in episode_seeds(_SEED, count, _EPISODES)
    ]


def _cold(bench: _Bench) -> Section:
    peers = bench.peers(start_step=0, warm=False)

    def peer_plan(peer: CasadiPlanner) -> Candidate:
        def plan(index: int) -> Answer:
            scenario = bench.scenarios[index]
            return peer.plan(scenario.initial_state, scenario.goal)

        return plan

    candidates: dict[str, Candidate] = {"SCP + PIQP (lagros)": bench.cold_plan}
    candidates |= {label: peer_plan(peer) for label, peer in peers.items()}
    times = interleave(candidates, bench.scale.plans)
    rows, gap = _against_first(times)
    if not peers:
        rows.append(absent_row("CasADi + IPOPT", "casadi"))
    steps = bench.scale.steps
    targets = [Target(f"cold plan, N = {steps}", 1e3 * times[rows[0].label].median, 10.0, "ms")]
    if peers:
        targets.append(Target("effort against CasADi, relative", gap, 1e-3, ""))
    return Section(
        f"Cold plan of a cart-pole episode, N = {steps}, from a straight line",
        rows,
        targets,
        [
            "The peers solve the same problem (multiple shooting, the same Runge-Kutta "
            "substeps) to 1e-6, expanded to scalar operations and built beforehand."
        ],
    )


def _warm(bench: _Bench) -> Section:
    planner = bench.planner

    def replan(start: Callable[[int], FloatArray]) -> Candidate:
        def plan(index: int) -> Trajectory:
            goal = bench.scenarios[index].goal
            return planner.plan(start(index), goal, 1, guess=bench.plans[index])

        return plan

    candidates: dict[str, Candidate] = {
        "lagros, perturbed state": replan(lambda index: bench.perturbed[index]),
        "lagros, nominal state": replan(lambda index: bench.plans[index].states[1]),
    }
    peers = bench.peers(start_step=1, warm=True)
    guesses = _peer_guesses(bench, peers)

    def peer_replan(label: str) -> Candidate:
        def plan(index: int) -> Answer:
            goal = bench.scenarios[index].goal
            return peers[label].plan(bench.perturbed[index], goal, guesses[label][index])

        return plan

    candidates |= {f"{label}, perturbed": peer_replan(label) for label in peers}
    times = interleave(candidates, bench.scale.plans)
    rows, _ = _against_first(times)
    if not peers:
        rows.append(absent_row("CasADi + IPOPT, perturbed", "casadi"))
    every = _every_step(bench)
    rows.append(timed_row("lagros, nominal, every step", every, None, "N from the full one to 1"))
    targets = [
        Target(f"warm re-plan, {which} state, median", 1e3 * times[label].median, 4.0, "ms")
        for which, label in (
            ("nominal", "lagros, nominal state"),
            ("perturbed", "lagros, perturbed state"),
        )
    ]
    return Section(
        f"Warm re-plan one step later, N = {bench.scale.steps - 1}",
        rows,
        targets,
        [
            f"Perturbed: x_d moved by {_PERTURBATION} in a random direction, what d̄ = 0.75 can do "
            "in one period. IPOPT starts from the solution and its multipliers, fatrop likewise."
        ],
    )


def _peer_guesses(bench: _Bench, peers: dict[str, CasadiPlanner]) -> dict[str, list[Answer]]:
    if not peers:
        return {}
    from speed.casadi_peer import rest_of

    cold = bench.peers(start_step=0, warm=False)
    return {
        label: [rest_of(cold[label].plan(s.initial_state, s.goal)) for s in bench.scenarios]
        for label in peers
    }


def _every_step(bench: _Bench) -> Times:
    """Time what the tube MPC does: re-plan from the nominal state at every step of an episode."""
    pairs = [
        (plan, scenario.goal, step)
        for plan, scenario in list(zip(bench.plans, bench.scenarios, strict=True))[:10]
        for step in range(1, bench.scale.steps)
    ]

    def replan(index: int) -> Trajectory:
        plan, goal, step = pairs[index]
        return bench.planner.plan(plan.states[step], goal, step, guess=plan)

    return interleave({"": replan}, len(pairs))[""]


def _against_first(times: dict[str, Times]) -> tuple[list[Row], float]:
    """Return a row each, with the efforts held against the first row's, and their largest gap."""
    reference = next(iter(times.values()))
    best = np.array([result.effort for result in reference.results])
    rows, gaps = [], [0.0]
    for label, taken in times.items():
        solved = np.array([result.solved for result in taken.results])
        effort = np.array([result.effort for result in taken.results])
        iterations = float(np.median([result.iterations for result in taken.results]))
        remark = f"solved {solved.sum()}/{solved.size}, {iterations:g} iterations"
        facts: dict[str, Any] = {"solved": int(solved.sum()), "iterations_median": iterations}
        same_problem = "nominal" not in label
        if taken is not reference and same_problem and solved.any():
            facts["effort_gap_max"] = float(np.max(np.abs(effort / best - 1.0)[solved]))
            gaps.append(facts["effort_gap_max"])
            remark += f", effort ±{facts['effort_gap_max']:.0e}"
        rows.append(timed_row(label, taken, reference, remark, **facts))
    return rows, max(gaps)


def _programs(bench: _Bench) -> Section:
    programs: list[QuadraticProgram] = []

    def recording(program: QuadraticProgram) -> QpSolution:
        programs.append(program)
        return solve_qp(program, ScpSettings().qp_tolerance)

    with qp_solvers.planning_with(recording):
        for index in range(bench.scale.plans):
            bench.cold_plan(index)
    solvers = qp_solvers.solvers()
    alone = interleave(
        {name: (lambda index, s=solver: s(programs[index])) for name, solver in solvers.items()},
        len(programs),
    )
    exact = [solve_with_clarabel(program, 1e-10).values for program in programs]

    def cold(solver: qp_solvers.Solver) -> Candidate:
        def plan(index: int) -> Trajectory:
            with qp_solvers.planning_with(solver):
                return bench.cold_plan(index)

        return plan

    whole = interleave({name: cold(s) for name, s in solvers.items()}, bench.scale.plans)
    reference, first = next(iter(alone.values())), next(iter(whole.values()))
    rows = []
    for name, taken in alone.items():
        values = [answer.values for answer in taken.results]
        off = max(_violation(p, z) for p, z in zip(programs, values, strict=True))
        far = max(float(np.max(np.abs(z - e))) for z, e in zip(values, exact, strict=True))
        solved = sum(answer.solved for answer in taken.results)
        rows.append(
            timed_row(
                name,
                taken,
                reference,
                f"residual {off:.0e}, off by {far:.0e}",
                solved=solved,
                programs=len(programs),
                violation_max=off,
                distance_from_optimum_max=far,
            )
        )
    for name, taken in whole.items():
        solved = sum(plan.solved for plan in taken.results)
        passes = float(np.mean([plan.iterations for plan in taken.results]))
        remark = f"solved {solved}/{bench.scale.plans}, {passes:.1f} programs"
        label = f"whole plan: {name}"
        rows.append(timed_row(label, taken, first, remark, solved=solved, programs_mean=passes))
    return Section(
        f"Quadratic programs of {bench.scale.plans} cold plans ({len(programs)} programs)",
        rows,
        notes=[
            "Residual: worst violation of a constraint; off by: worst distance from the optimum "
            "(Clarabel at 1e-10). PIQP and Clarabel at 1e-8. Whole plan: the same SCP with this "
            "solver; its ratio is to the first whole plan."
        ],
    )


def _violation(program: QuadraticProgram, values: FloatArray) -> float:
    return qp_solvers.violation(program, values)


def _slopes(bench: _Bench) -> Section:
    def planning(substeps: int) -> Candidate:
        settings = CartPolePlannerSettings(scp=ScpSettings(slope_substeps=substeps))
        planner = CartPolePlanner(bench.planner.task, settings)

        def plan(index: int) -> Trajectory:
            scenario = bench.scenarios[index]
            return planner.plan(scenario.initial_state, scenario.goal)

        return plan

    in_use = ScpSettings().slope_substeps
    order = sorted((1, 2, 4), key=lambda count: count != in_use)
    times = interleave(
        {f"slope_substeps={count}": planning(count) for count in order}, bench.scale.plans
    )
    reference = times[f"slope_substeps={in_use}"]
    exact = np.array([plan.effort for plan in times["slope_substeps=4"].results])
    rows = []
    for label, taken in times.items():
        effort = np.array([plan.effort for plan in taken.results])
        solved = np.array([plan.solved for plan in taken.results])
        passes = float(np.mean([plan.iterations for plan in taken.results]))
        gap = float(np.max(np.abs(effort / exact - 1.0)[solved], initial=0.0))
        rows.append(
            timed_row(
                label,
                taken,
                reference,
                f"solved {solved.sum()}/{solved.size}, {passes:.1f} programs, effort ±{gap:.0e}",
                solved=int(solved.sum()),
                programs_mean=passes,
                effort_gap_max=gap,
            )
        )
    return Section(
        "Runge-Kutta substeps behind the slopes (cold plan)",
        rows,
        notes=["Effort against that of slopes from the full four substeps, the exact ones."],
    )


def _share(bench: _Bench) -> Section:
    scenarios = _draw(bench.planner.task, bench.scale.episodes)

    def plan(index: int) -> Trajectory:
        return bench.planner.plan(scenarios[index].initial_state, scenarios[index].goal)

    taken = interleave({"": plan}, len(scenarios))[""]
    solved = [answer for answer in taken.results if answer.solved]
    share = 100.0 * len(solved) / len(scenarios)
    defect = max((answer.defect for answer in solved), default=float("nan"))
    most = max(answer.iterations for answer in taken.results)
    row = timed_row(
        f"{len(scenarios)} random episodes",
        taken,
        None,
        f"{share:.1f} % solved, at most {most} programs",
        solved_share=share / 100.0,
        defect_max=defect,
        iterations_max=most,
        slowest_s=float(taken.seconds.max()),
    )
    worst = Row("worst defect of a solved plan", remark=f"{defect:.1e} (true dynamics)")
    return Section(
        "Share of solved cold plans",
        [row, worst],
        [
            Target("cold plans solved", share, 99.0, "%", at_least=True),
            Target("worst defect of a solved plan", defect, 1e-6, ""),
        ],
    )

"""Planning: cold and warm plans against CasADi, and the share of episodes that is solved."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from lagros_policies.planning import Trajectory
from speed import programs
from speed.episodes import PERTURBATION, Bench, draw
from speed.report import Row, Section, Target, absent_row, timed_row
from speed.timing import Candidate, Scale, Times, interleave

if TYPE_CHECKING:
    from speed.casadi_peer import Answer, CasadiPlanner

# Episodes along which every step is planned again.
_EPISODES = 10
_REMARKS = "Remarks: plans solved, median iterations, largest relative gap of the effort."


def sections(scale: Scale) -> list[Section]:
    """Measure and return the tables."""
    bench = Bench.prepare(scale)
    return [_cold(bench), _warm(bench), *programs.sections(bench), _share(bench)]


def _cold(bench: Bench) -> Section:
    def planning(peer: CasadiPlanner) -> Candidate:
        def plan(index: int) -> Answer:
            scenario = bench.scenarios[index]
            return peer.plan(scenario.initial_state, scenario.goal)

        return plan

    ours = "SCP + PIQP (lagros)"
    peers = bench.peers(start_step=0, warm=False)
    times = interleave(
        {ours: bench.cold(), **{label: planning(peer) for label, peer in peers.items()}},
        bench.scale.plans,
    )
    rows = [_row(label, taken, times[ours]) for label, taken in times.items()]
    targets = [
        Target(f"cold plan, N = {bench.scale.steps}, median", 1e3 * times[ours].median, 10.0, "ms")
    ]
    if peers:
        gap = max(row.facts["effort_gap_max"] for row in rows)
        targets.append(Target("effort against CasADi, relative", gap, 1e-3, ""))
    else:
        rows.append(absent_row("CasADi + IPOPT", "casadi"))
    return Section(
        f"Cold plan of a cart-pole episode, N = {bench.scale.steps}, from a straight line",
        rows,
        targets,
        [
            "The peers solve the same problem (multiple shooting, the same Runge-Kutta substeps) "
            "to 1e-6, expanded to scalar operations and built beforehand. " + _REMARKS
        ],
        tails=True,
    )


def _warm(bench: Bench) -> Section:
    peers = bench.peers(start_step=1, warm=True)
    guesses = _guesses(bench, peers)

    def planning(label: str) -> Candidate:
        def plan(index: int) -> Answer:
            goal = bench.scenarios[index].goal
            return peers[label].plan(bench.perturbed[index], goal, guesses[label][index])

        return plan

    perturbed, nominal = "lagros, perturbed state", "lagros, nominal state"
    times = interleave(
        {
            perturbed: bench.warm(),
            nominal: bench.warm(nominal=True),
            **{f"{label}, perturbed": planning(label) for label in peers},
        },
        bench.scale.plans,
    )
    rows = [
        _row(label, taken, times[perturbed], same_problem=label != nominal)
        for label, taken in times.items()
    ]
    if not peers:
        rows.append(absent_row("CasADi + IPOPT, perturbed", "casadi"))
    every = _every_step(bench)
    rows.append(timed_row("lagros, nominal, every step", every, None, "N down to 1"))
    return Section(
        f"Warm re-plan one step later, N = {bench.scale.steps - 1}",
        rows,
        [
            Target("warm re-plan, nominal state, median", 1e3 * times[nominal].median, 4.0, "ms"),
            Target(
                "warm re-plan, perturbed state, median", 1e3 * times[perturbed].median, 4.0, "ms"
            ),
        ],
        [
            f"Perturbed: x_d moved by {PERTURBATION} in a random direction, what d̄ = 0.75 can do "
            "in one period. The peers start from their solution and its multipliers. The tube MPC "
            "plans from the nominal state."
        ],
        tails=True,
    )


def _guesses(bench: Bench, peers: dict[str, CasadiPlanner]) -> dict[str, list[Answer]]:
    """Return what each peer starts from: its own cold plans without their first step."""
    if not peers:
        return {}
    from speed.casadi_peer import rest_of

    cold = bench.peers(start_step=0, warm=False)
    return {
        label: [rest_of(cold[label].plan(s.initial_state, s.goal)) for s in bench.scenarios]
        for label in peers
    }


def _every_step(bench: Bench) -> Times:
    """Time what the tube MPC does: plan again from the nominal state at every step."""
    tasks = [
        (plan, scenario.goal, step)
        for plan, scenario in list(zip(bench.plans, bench.scenarios, strict=True))[:_EPISODES]
        for step in range(1, bench.scale.steps)
    ]

    def plan_again(index: int) -> Trajectory:
        plan, goal, step = tasks[index]
        return bench.planner.plan(plan.states[step], goal, step, guess=plan)

    return interleave({"": plan_again}, len(tasks))[""]


def _row(label: str, times: Times, reference: Times, same_problem: bool = True) -> Row:
    """Return a planner's row; its efforts are held against those of the reference."""
    solved = np.array([result.solved for result in times.results])
    iterations = float(np.median([result.iterations for result in times.results]))
    remark = f"{solved.sum()}/{solved.size}, {iterations:g} it."
    facts: dict[str, Any] = {"solved": int(solved.sum()), "iterations_median": iterations}
    if same_problem:
        effort = np.array([result.effort for result in times.results])
        best = np.array([result.effort for result in reference.results])
        gap = float(np.max(np.abs(effort / best - 1.0)[solved], initial=0.0))
        facts["effort_gap_max"] = gap
        if times is not reference:
            remark += f", ±{gap:.0e}"
    return timed_row(label, times, reference, remark, **facts)


def _share(bench: Bench) -> Section:
    scenarios = draw(bench.planner.task, bench.scale.episodes)

    def plan(index: int) -> Trajectory:
        return bench.planner.plan(scenarios[index].initial_state, scenarios[index].goal)

    times = interleave({"": plan}, len(scenarios))[""]
    solved = [answer for answer in times.results if answer.solved]
    share = 100.0 * len(solved) / len(scenarios)
    defect = max((answer.defect for answer in solved), default=float("nan"))
    most = max(answer.iterations for answer in times.results)
    row = timed_row(
        f"{len(scenarios)} random episodes",
        times,
        None,
        f"{share:.1f} % solved, at most {most} QPs, worst defect {defect:.1e}",
        solved_share=share / 100.0,
        defect_max=defect,
        iterations_max=most,
        slowest_s=float(times.seconds.max()),
    )
    return Section(
        "Share of cold plans that are solved",
        [row],
        [
            Target("cold plans solved", share, 99.0, "%", at_least=True),
            Target("worst defect of a solved plan", defect, 1e-6, ""),
        ],
        ["Defect: of the true dynamics, in units of the state."],
        tails=True,
    )

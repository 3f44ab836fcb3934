"""Guarantees of episodes: what is proved, what searches come to, and what is said of both."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from lagros_benchmarks.commands.certify import print_certificate
from lagros_benchmarks.evidence import columns, guaranteed, words
from lagros_benchmarks.evidence.columns import Guaranteed
from lagros_benchmarks.evidence.guaranteed import evidence_of
from lagros_benchmarks.evidence.loops import Loop, directions_of, loop_named, shown
from lagros_benchmarks.evidence.predicted import prediction_of, reached
from lagros_benchmarks.report.records import summarise
from lagros_benchmarks.report.tables import csv_text, latex_text, markdown_text, terminal_table
from lagros_benchmarks.run.runner import kept_in, run_benchmark
from lagros_benchmarks.run.settings import BenchmarkSettings
from lagros_benchmarks.worst_case.aimed import supports
from lagros_benchmarks.worst_case.flights import applied, draw_episodes
from lagros_benchmarks.worst_case.search import SearchSettings
from lagros_envs.dynamics import linearise_hold
from lagros_envs.registry import find_task
from lagros_envs.seeding import episode_seeds
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_envs.tasks.pvtol.task import PvtolSettings
from lagros_policies.contraction.certificate import Certificate, TubeSizes
from lagros_policies.contraction.feedback import riccati_gains
from lagros_policies.expert import Expert
from lagros_policies.policy import make
from lagros_policies.proof.plan_tube import plan_tubes

QUICK = SearchSettings("gradient", budget=80, restarts=1)
KINDS = ("uniform", "constant")


def linear_loop(task, weights, count=3, flown=1.0, shrunk=1.0):
    """Return plans tracked by a regulator, and the tubes of that loop.

    Args:
        task: The task.
        weights: Diagonals of Q and R.
        count: Episodes.
        flown: The gain that flies, as a multiple of the one whose tubes are proved.
        shrunk: By what the tubes are multiplied.
    """
    episodes = draw_episodes(Expert(task), episode_seeds(4, count, 98765), shown)
    _, by_state, by_control = linearise_hold(
        task.system, episodes.plans[:, :-1], episodes.controls, task.control_period
    )
    steps, n, m = task.steps, task.system.state_dim, task.system.control_dim
    state, control = (
        np.broadcast_to(part, size) for part, size in zip(weights, (n, m), strict=True)
    )
    gains = -riccati_gains(
        by_state, by_control, np.tile(state, (steps + 1, 1)), np.tile(control, (steps, 1))
    )

    def law(states, episode, step):
        error = states - episodes.plans[episode, step]
        change = np.einsum("bmn,bn->bm", flown * gains[episode, step], error)
        return applied(task, task.action(episodes.controls[episode, step] + change))

    def tubes(bound, tell=None):
        found = plan_tubes(
            task.system,
            task.control_period,
            episodes.plans,
            episodes.controls,
            gains,
            bound,
            directions=directions_of(task),
            control_low=np.array(task.control_low),
            control_high=np.array(task.control_high),
            control_centre=np.array(task.control_centre),
        )
        sizes = {name: shrunk * getattr(found, name) for name in ("outputs", "norm", "between")}
        return replace(found, **sizes)

    return Loop(episodes, law, tubes)


CARTPOLE = ((3.0, 1.0, 1.0, 1.0), 0.03)
# Short, so that its tubes take little.
SHORT = CartPoleSettings(time_limit=4.0)


@pytest.fixture(scope="module")
def cartpole_evidence():
    loop = linear_loop(SHORT, CARTPOLE)
    return loop, evidence_of(loop, 0.1, KINDS, QUICK)


def test_the_cartpole_is_guaranteed_and_a_search_comes_near_the_bound(cartpole_evidence):
    loop, found = cartpole_evidence
    assert found.count == found.asked == 3
    assert found.contradicted == 0
    assert np.all(found.shares <= 1.0)
    assert np.all(found.shares >= 0.66)
    line = words.headline(SHORT, loop, found, 0.1)
    assert line.startswith(
        "guaranteed for 3 of 3 episodes at d̄ = 0.1: reaches the goal, |theta| ≤ "
    )
    assert "rad, whatever the disturbance does; the search came to" in line
    assert [one.holds for one in words.proved_lines(SHORT, loop, found)] == [True] * 2
    record = guaranteed.as_json(found, SHORT)
    json.dumps(record, allow_nan=False)
    assert record["share"] == 1.0
    bounds = record["state_bounds"]
    assert list(bounds) == ["p", "theta", "dp/dt", "dtheta/dt"]
    shares = list(record["search"]["shares_of_bounds"].values())
    assert len(shares) == 4
    assert 0.5 < min(shares) <= max(shares) <= 1.0
    # What flew is below what is proved, and above what the plans do by themselves.
    theta = np.abs(loop.episodes.plans[..., 1]).max()
    assert theta < bounds["theta"] < math.pi / 2


def test_what_is_not_known_between_the_instants_is_not_claimed(cartpole_evidence):
    loop, found = cartpole_evidence
    unknown = found.proved.error.copy()
    unknown[0] = np.inf
    some = replace(found, proved=replace(found.proved, error=unknown))
    none = replace(found, proved=replace(found.proved, error=np.full_like(unknown, np.inf)))
    said, less, least = (
        words.proved_lines(SHORT, loop, one)[0].text for one in (found, some, none)
    )
    assert "instants and between them: " in said
    assert f"and between them around {np.sum(found.proved.closed) - 1}: " in less
    assert "instants alone: " in least
    assert "by coordinate" not in least
    assert not any("inf" in one for one in (said, less, least))
    state = np.full_like(found.proved.state, np.inf)
    blind = replace(none, proved=replace(none.proved, state=state))
    assert "reaches the goal, ‖x − x_d‖ ≤ " in words.headline(SHORT, loop, blind, 0.1)
    record = json.loads(json.dumps(guaranteed.as_json(blind, SHORT), allow_nan=False))
    assert set(record["state_bounds"].values()) == {None}
    assert record["norm_bound"] > 0.0


@pytest.mark.parametrize("flown", [-1.0, 0.4, 2.5])
def test_a_planted_wrong_gain_is_refuted(flown):
    """The tubes are of one gain, another flies: the search finds it out, whatever is proved."""
    loop = linear_loop(SHORT, CARTPOLE, flown=flown)
    found = evidence_of(loop, 0.1, (), QUICK)
    assert found.contradicted > 0
    assert words.headline(SHORT, loop, found, 0.1).startswith("CONTRADICTED in ")
    assert not words.search_line(found).holds


def test_a_tube_that_is_a_tenth_too_small_is_crossed():
    loop = linear_loop(SHORT, CARTPOLE, count=2, shrunk=0.9)
    found = evidence_of(loop, 0.02, (), QUICK)
    assert found.contradicted == 2
    assert guaranteed.as_json(found, SHORT)["search"]["contradicted"] == 2


@pytest.mark.parametrize(
    ("task", "weights", "bound", "said"),
    [
        (PvtolSettings(), (1.0, 0.5), 0.02, "touches no disc, |phi| ≤ "),
        ("car", (1.0, 0.5), 0.05, "touches no disc, ‖x − x_d‖ ≤ "),
    ],
    ids=["pvtol", "car"],
)
def test_flights_among_discs_never_contradict_what_is_guaranteed(task, weights, bound, said):
    described = find_task(task) if isinstance(task, str) else task
    loop = linear_loop(described, weights, count=2)
    found = evidence_of(loop, bound, KINDS, QUICK)
    assert found.count == 2
    assert found.contradicted == 0
    assert said in words.headline(described, loop, found, bound)


def test_nothing_is_guaranteed_where_no_tube_closes():
    task = SHORT
    loop = linear_loop(task, CARTPOLE, count=2)
    found = evidence_of(loop, 3.0, (), replace(QUICK, budget=10))
    assert found.count == 0
    line = words.headline(task, loop, found, 3.0)
    assert line.startswith("guaranteed for 0 of 2 episodes at d̄ = 3; not shown: tube (2); ")
    assert words.proved_lines(task, loop, found) == []
    record = guaranteed.as_json(found, task)
    json.dumps(record, allow_nan=False)
    assert record["norm_bound"] is record["state_bounds"] is record["search"]["share_of_bound"]
    assert record["not_shown"] == {"tube": 2}
    assert record["smaller_bound"] is None


def test_a_smaller_bound_is_looked_for_where_nothing_is_guaranteed():
    loop = linear_loop(SHORT, CARTPOLE, count=2)
    found = evidence_of(loop, 1.6, (), replace(QUICK, budget=10), most_seconds=60.0)
    assert found.count == 0
    bound, count = found.smaller
    assert count == 2
    assert 1.6 / bound == pytest.approx(2.0 ** round(np.log2(1.6 / bound)))
    line = words.headline(SHORT, loop, found, 1.6)
    assert f"0 of 2 episodes at d̄ = 1.6, and for {count} at d̄ = {bound:.3g}; not shown:" in line
    assert evidence_of(loop, bound, (), replace(QUICK, budget=10)).count == count
    # Nothing larger was left out.
    assert evidence_of(loop, 2.0 * bound, (), replace(QUICK, budget=10)).count < count


@pytest.mark.parametrize("policy", ["tube-mpc", "tube-mpc:half-rate", "lqr-plan"])
def test_every_law_that_is_a_gain_along_a_plan_is_spoken_of(policy):
    loop = loop_named(policy, SHORT, episode_seeds(6, 2, 98765))
    found = evidence_of(loop, 0.02, KINDS, QUICK)
    assert found.count == 2
    assert found.contradicted == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("policy", "task", "bound"),
    [
        ("tube-mpc", "cartpole", 0.1),
        ("tube-mpc", "cartpole", 0.25),
        ("tube-mpc", "pvtol", 0.05),
        ("tube-mpc", "car", 0.1),
        ("tube-mpc", "car", 0.3),
        ("tube-mpc", "quadrotor", 0.2),
        ("tube-mpc", "arm", 0.3),
        ("lagros", "arm", 0.05),
        ("lagros", "cartpole", 0.001),
        ("lagros", "cartpole", 0.05),
    ],
)
def test_no_search_contradicts_what_is_guaranteed_of_the_shipped_loops(policy, task, bound):
    loop = loop_named(policy, find_task(task), episode_seeds(7, 10, 98765))
    found = evidence_of(loop, bound, ("uniform", "sphere", "constant", "gust"))
    assert found.contradicted == 0


@pytest.mark.parametrize("policy", ["tube-mpc:projected", "tube-mpc:least-norm", "tube-mpc:tuned"])
def test_no_statement_is_about_a_law_that_is_no_gain(policy):
    loop = loop_named(policy, SHORT, episode_seeds(6, 1, 98765))
    assert loop.tubes is None
    assert policy in loop.why


@pytest.mark.parametrize("policy", ["lqr", "learned", "random", "ppo"])
def test_no_statement_is_about_a_policy_of_another_loop(policy):
    task = find_task("cartpole")
    loop = loop_named(policy, task, episode_seeds(4, 1, 98765))
    assert loop.tubes is None
    assert policy in loop.why
    if policy == "random":  # it draws: a search has nothing to climb
        return
    found = evidence_of(loop, 0.1, (), replace(QUICK, budget=10))
    assert guaranteed.as_json(found, task) is None
    assert found.count == found.contradicted == 0
    line = words.headline(task, loop, found, 0.1)
    assert line.startswith(f"nothing is guaranteed: no statement of ours is about {policy}")
    assert words.proved_lines(task, loop, found) == []
    assert words.search_line(found).holds


def test_what_plans_anew_or_is_derived_by_a_user_is_another_loop():
    from lagros_benchmarks.worst_case.flights import tracked_by
    from lagros_policies.tube_mpc import ReplanningTubeMpcPolicy, TubeMpcPolicy

    class Mine(TubeMpcPolicy):
        """Another law, maybe."""

    assert tracked_by(TubeMpcPolicy()) is not None
    for other in (Mine(), TubeMpcPolicy(replan_every=3), ReplanningTubeMpcPolicy(), object()):
        assert tracked_by(other) is None


@pytest.mark.parametrize("task", [CartPoleSettings(), PvtolSettings()], ids=lambda task: task.name)
def test_the_motions_are_the_plans_that_the_policy_makes(task):
    seeds = episode_seeds(5, 2, 98765)
    env = gym.make(task.env_id, disable_env_checker=True)
    policy = make("tube-mpc", env)
    flown = loop_named("tube-mpc", task, seeds).episodes
    for index, seed in enumerate(seeds):
        observation, _ = env.reset(seed=seed)
        _, state = policy.predict(observation)
        np.testing.assert_array_equal(state[0].plan.states, flown.plans[index])
        np.testing.assert_array_equal(env.unwrapped.state, flown.initial_states[index])
        np.testing.assert_array_equal(env.unwrapped.scenario.goal, flown.goals[index])


def test_what_is_predicted_is_what_small_flights_reach_and_no_more():
    loop = linear_loop(SHORT, CARTPOLE, count=2)
    found = prediction_of(loop)
    bound = 1e-3
    worst = evidence_of(loop, bound, (), QUICK).worst
    assert 0.9 * found.error <= worst.error.max() / bound <= 1.01 * found.error
    assert found.last < found.error
    # The goal is as far away as the plan leaves it, and as the radius allows.
    radius = SHORT.success_radius(SHORT.time_limit)
    assert found.bound == pytest.approx(radius / found.last, rel=0.01)
    assert "of which nothing is proved" in found.text


def test_no_direction_of_a_linear_loop_exceeds_what_is_predicted():
    rng = np.random.default_rng(2)
    by_state = 0.8 * rng.uniform(-1.0, 1.0, (3, 12, 3, 3))
    by_push, output = rng.uniform(-1.0, 1.0, (3, 12, 3, 3)), rng.standard_normal((2, 3))
    bound = reached(by_state, by_push, output)
    angles = np.linspace(0.0, np.pi, 721)
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=-1) @ output
    best = supports(by_state, by_push, np.broadcast_to(rays, (3, *rays.shape)))[0].max(axis=1)
    np.testing.assert_array_less(best, bound.max(axis=1) * (1.0 + 1e-12))
    np.testing.assert_allclose(bound.max(axis=1), best, rtol=0.02)


def test_a_prediction_of_a_plane_counts_the_position_alone():
    task = find_task("car")
    found = prediction_of(linear_loop(task, (1.0, 0.5), count=2))
    assert found.bound * found.last > task.goal_radius


# The columns of a benchmark


def fake(policy, task, seeds, bound):
    """Guarantee every second episode of tube-mpc, and count what is asked."""
    fake.asked.append((policy.name, tuple(seeds), bound))
    if policy.name != "tube-mpc":
        return None
    motion = np.zeros((task.steps + 1, task.system.state_dim))
    wide = np.full(task.steps + 1, 50.0)
    return {
        seed: Guaranteed(index % 2 == 0, motion, wide if index < 3 else np.inf * wide)
        for index, seed in enumerate(seeds[:-1])
    }


@pytest.fixture
def faked(monkeypatch):
    fake.asked = []
    monkeypatch.setattr(columns, "guaranteed", fake)


SETTINGS = BenchmarkSettings(
    policies=("tube-mpc", "lqr"),
    episodes=5,
    disturbances=("uniform", "none", "constant"),
    bounds=(0.1, 0.2),
    guarantee=True,
)


@pytest.mark.usefixtures("faked")
def test_a_bound_is_proved_once_and_shared_by_the_kinds():
    run = run_benchmark(SETTINGS)
    asked = [(name, bound) for name, _, bound in fake.asked]
    assert sorted(asked) == sorted(
        (name, bound) for name in ("tube-mpc", "lqr") for bound in (0.0, 0.1, 0.2)
    )
    for row in summarise(run):
        if row["policy"] == "lqr":
            assert row["guaranteed_rate"] is row["guaranteed_ci95"] is None
            assert row["bound_over_worst"] is row["guarantees_contradicted"] is None
            continue
        # Of the five one has no plan.
        assert row["guaranteed_rate"] == 0.4
        assert row["guarantees_contradicted"] == 0
        records = run.episodes[
            next(
                case
                for case in run.episodes
                if case.policy == "tube-mpc"
                and case.condition == (row["disturbance"], row["bound"])
            )
        ]
        kept = [record for record in records if record.guaranteed]
        nominal = {plan.seed: plan.states for plan in run.plans}
        for record in records[:3]:
            apart = np.linalg.norm(nominal[record.seed], axis=-1).max()
            assert record.error_bound == pytest.approx(50.0 + apart)
        assert [record.error_bound for record in records[3:]] == [None, None]
        wanted = max(one.error_bound for one in kept) / max(one.max_tracking_error for one in kept)
        assert row["bound_over_worst"] == pytest.approx(wanted)


@pytest.mark.usefixtures("faked")
def test_the_columns_stand_in_every_table_and_nowhere_when_not_asked():
    rows = summarise(run_benchmark(replace(SETTINGS, disturbances=("uniform",), bounds=(0.1,))))
    assert "proved" in latex_text(rows)
    assert "| proved [%] | bound [/worst] |" in markdown_text(rows)
    assert "guaranteed_ci95_low" in csv_text(rows)
    grid = summarise(run_benchmark(replace(SETTINGS, disturbances=("uniform",))))
    assert "| d̄ | (b) tube-mpc, proved [%] | lqr, proved [%] |" in markdown_text(grid)
    plain = summarise(run_benchmark(replace(SETTINGS, episodes=2, guarantee=False)))
    assert "proved" not in latex_text(plain) + markdown_text(plain)
    assert all(row["guaranteed_rate"] is None for row in plain)
    assert [str(one.header) for one in terminal_table(rows).columns][-2:] == [
        "proved\n%",
        "bound\n/worst",
    ]


def test_flights_of_a_benchmark_keep_what_is_guaranteed_of_them():
    settings = BenchmarkSettings(
        policies=("tube-mpc", "lqr"),
        episodes=2,
        disturbances=("constant", "sphere"),
        bounds=(0.05,),
        guarantee=True,
    )
    run = run_benchmark(settings)
    for row in summarise(run):
        if row["policy"] == "lqr":
            assert row["guaranteed_rate"] is None
            continue
        assert row["guaranteed_rate"] == 1.0
        assert row["guarantees_contradicted"] == 0
        assert row["certified_violation_rate"] == 0.0
        assert np.all(np.array(row["certified_tube"]) >= row["mean_tracking_error"])
        assert row["bound_over_worst"] >= 1.0
        # Larger than the bound of the linear error would be no use.
        assert row["bound_over_worst"] < 20.0


@pytest.mark.usefixtures("faked")
def test_a_guarantee_that_a_flight_contradicts_is_counted(monkeypatch):
    def wrong(policy, task, seeds, bound):
        motion = np.zeros((task.steps + 1, task.system.state_dim))
        return {seed: Guaranteed(True, motion, np.zeros(task.steps + 1)) for seed in seeds}

    monkeypatch.setattr(columns, "guaranteed", wrong)
    short = np.full(CartPoleSettings().steps + 1, 1e-3)
    monkeypatch.setattr(Guaranteed, "error_bounds", lambda self, nominal: short)
    settings = replace(SETTINGS, policies=("lqr",), disturbances=("uniform",), bounds=(0.1,))
    (row,) = summarise(run_benchmark(settings))
    assert row["guarantees_contradicted"] == 5
    assert row["certified_violation_rate"] == 1.0
    assert row["certified_tube"] == [1e-3] * len(short)


@pytest.mark.usefixtures("faked")
def test_a_run_that_goes_on_keeps_its_guarantees(tmp_path):
    settings = replace(SETTINGS, policies=("tube-mpc",), bounds=(0.1,), episodes=4, chunk=2)
    whole = run_benchmark(settings)
    kept = kept_in(tmp_path, settings)
    run_benchmark(settings, kept=kept)
    count = len(fake.asked)
    again = run_benchmark(settings, kept=kept_in(tmp_path, settings))
    assert len(fake.asked) == count
    assert again.episodes == whole.episodes
    assert kept_in(tmp_path, replace(settings, guarantee=False)).key != kept.key


def test_worlds_of_agents_have_no_such_column():
    with pytest.raises(ValueError, match="guarantee=True is for one body"):
        BenchmarkSettings.for_task("spacecraft", guarantee=True)


def test_a_bound_of_a_nominal_beside_the_motion_counts_the_way_between():
    one = Guaranteed(True, np.zeros((3, 2)), np.array([0.0, 1.0, 2.0]))
    beside = np.array([[0.0, 0.0], [3.0, 4.0], [0.0, 1.0]])
    np.testing.assert_array_equal(one.error_bounds(beside), [0.0, 6.0, 3.0])
    assert one.error_bounds(None) is None
    assert replace(one, norm=np.array([0.0, 1.0, np.inf])).error_bounds(np.zeros((3, 2))) is None


def test_the_line_comes_first_and_in_one_piece(capsys):
    found = Certificate.of_flights(
        task="cartpole",
        policy="tube-mpc",
        epsilon_l=None,
        d_bar=0.1,
        tube=TubeSizes(3.15, None, 0.1),
        statements=(),
        headline="guaranteed " * 12,
    )
    print_certificate(found)
    assert capsys.readouterr().out.splitlines()[0] == "guaranteed " * 12
    record = found.as_json()
    assert record["guarantee"] is record["alpha"] is record["metric"] is None

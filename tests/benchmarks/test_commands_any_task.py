"""Attack, certify, watch, train and data on a task that no package knows: a puck among discs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

import lagros_policies
from lagros_benchmarks.commands import cli
from lagros_benchmarks.training.settings import FINAL
from lagros_benchmarks.worst_case.flights import (
    Episodes,
    disc_gap,
    draw_episodes,
    fly,
    policy_law,
    random_pushes,
)
from lagros_benchmarks.worst_case.goals import GOALS, gradient, scores
from lagros_benchmarks.worst_case.single import replay_single
from lagros_envs.registry import find_task, register_task
from lagros_envs.seeding import episode_seeds
from lagros_envs.task import MetricDesign
from lagros_policies.contraction import (
    BoxRegion,
    CvStemSettings,
    design_on_region,
    save_metric,
    verify_metric,
)
from lagros_policies.contraction.basis import CONSTANT
from lagros_policies.expert import Expert
from tests.benchmarks.toys import Slide, Straight
from tests.found import SINGLE_BODY, named, task_of

FILE = Path(__file__).parent / "toys.py"
POLICY = ("--policy", "tests.benchmarks.toys:Straight")
SLIDE: Any = find_task(str(FILE))


@pytest.fixture(scope="module")
def episodes() -> Episodes:

    return draw_episodes(Expert(SLIDE), episode_seeds(0, 6, 12345))


@pytest.fixture
def invoke(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: CliRunner().invoke(cli.app, [*map(str, arguments)])


def of(episodes: Episodes, count: int, bound: float) -> tuple[Any, Any, Any]:
    law, where = policy_law(Straight(SLIDE), episodes), np.arange(count)
    pushes = random_pushes(episodes, "uniform", bound)[:count]
    return where, pushes, fly(episodes, law, where, pushes)


# Flights in batches


def test_a_batch_flies_what_the_environment_flies(episodes: Episodes) -> None:
    where, pushes, flown = of(episodes, 6, 0.3)
    ends = []
    for index in where:
        outcome, real = replay_single(episodes, index, Straight(SLIDE), "clearance", pushes[index])
        assert real is not None
        np.testing.assert_allclose(real.states[0], flown.states[index], atol=2e-6)
        np.testing.assert_array_equal(real.alive[0], flown.alive[index])
        assert bool(flown.collided[index]) == outcome.measures["collided"]
        score = scores(episodes, "clearance", where, flown)[0][index]
        assert outcome.score == pytest.approx(score, abs=2e-6)
        assert outcome.broken == outcome.measures["collided"]
        ends.append(outcome.broken)
    # The straight way leads through the disc in some episodes, and past it in others.
    assert set(ends) == {True, False}


def test_the_gap_is_that_of_many_points_on_the_way() -> None:
    rng = np.random.default_rng(0)
    before, after = rng.normal(size=(2, 50, 4))
    discs = np.concatenate([rng.normal(size=(50, 2, 2)), rng.uniform(0, 1, (50, 2, 1))], axis=-1)
    discs[::2, 1] = 0.0  # none
    share = np.linspace(0.0, 1.0, 2001)[:, None, None]
    way = ((1.0 - share) * before + share * after)[..., None, :2] - discs[..., :2]
    away = np.linalg.norm(way, axis=-1) - discs[..., 2] - SLIDE.body_radius
    away = np.where(discs[..., 2] > 0.0, away, np.inf)
    expected = away.min(axis=(0, 2))
    np.testing.assert_allclose(disc_gap(SLIDE, before, after, discs), expected, atol=2e-3)


@pytest.mark.parametrize("goal", GOALS)
def test_slopes_point_where_the_score_grows(goal: str, episodes: Episodes) -> None:
    law = policy_law(Straight(SLIDE), episodes)
    where, pushes, flown = of(episodes, 6, 0.05)
    slope = gradient(episodes, law, goal, where, pushes, flown)
    ray = slope / np.linalg.norm(slope, axis=(1, 2), keepdims=True)
    ahead = scores(episodes, goal, where, fly(episodes, law, where, pushes + 2e-3 * ray))[0]
    behind = scores(episodes, goal, where, fly(episodes, law, where, pushes - 2e-3 * ray))[0]
    # Where a flight ends at a disc a later instant counts: there the score may jump.
    whole = ~flown.collided
    assert np.all((ahead > behind)[whole])


# Commands


def test_an_attack_is_searched_flown_and_flown_again(invoke: Any) -> None:
    arguments = ("attack", FILE, *POLICY, "--budget", 200, "--bound", 0.3)
    result = invoke(*arguments, "--goal", "clearance", "--json", "a.json", "--npz", "a.npz")
    assert result.exit_code == 0, result.output
    row = json.loads(Path("a.json").read_text())
    assert (row["task"], row["bound"], row["episodes"]) == ("slider", 0.3, 2)
    assert row["score_worst"] > row["random_score_worst"]
    assert row["least_gap_min"] < 0.0
    assert "in_region_rate" not in row
    again = invoke("attack", FILE, *POLICY, "--replay", "a.npz")
    assert again.exit_code == 0, again.output
    assert again.output.count("as stored") == 2


def test_a_film_shows_the_puck_at_the_disc(invoke: Any) -> None:
    result = invoke("watch", FILE, *POLICY, "--disturbance", "none", "--video", "a.gif")
    assert result.exit_code == 0, result.output
    assert "collided" in result.output
    with Image.open("a.gif") as image:
        assert image.n_frames > 10
        assert image.size == (800, 500)


def test_what_a_task_of_one_body_lacks_is_said(invoke: Any) -> None:
    for options, message in (
        (("watch", FILE, "--agents", 2), "--agents is for worlds of many agents"),
        (("attack", FILE, "--safety-filter"), "for worlds of many agents"),
        (("train", FILE, "--parallel-env"), "--parallel-env is for many agents"),
        (("certify", FILE, "--episodes", 0), "slider has no contraction metric"),
    ):
        result = invoke(*options)
        assert result.exit_code in (1, 2), result.output
        assert message in result.output


@pytest.mark.parametrize("task", named(SINGLE_BODY))
def test_every_task_of_one_body_is_shown_and_attacked_alike(task: str, invoke: Any) -> None:
    result = invoke("watch", task, "--policy", "lqr", "--seconds", 0.5, "--video", "a.gif")
    assert result.exit_code == 0, result.output
    assert "lqr on seed 0, uniform" in result.output
    quick = ("--policy", "lqr", "--episodes", 1, "--budget", 30, "--goal", "tube")
    result = invoke("attack", task, *quick, "--json", "a.json")
    assert result.exit_code == 0, result.output
    row = json.loads(Path("a.json").read_text())
    assert row["score_worst"] >= row["search_scores"][0] - 1e-3
    published = task_of(task).tube_radius(0.0) is not None
    assert (row["outcomes"][0]["measures"]["left_paper_tube"] is not None) == published


def test_flights_of_a_task_without_a_metric_are_guaranteed(invoke: Any) -> None:
    result = invoke("certify", FILE, "--bound", 0.01, "--episodes", 2, "--json", "c.json")
    assert result.exit_code == 0, result.output
    line = result.stdout.splitlines()[0]
    assert line.startswith("guaranteed for 2 of 2 episodes at d̄ = 0.01: reaches the goal, touches")
    found = json.loads(Path("c.json").read_text())
    assert found["guarantee"]["guaranteed"] == 2
    assert found["guarantee"]["search"]["contradicted"] == 0


# With a metric


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Slide:
    """Return the task with a constant metric, which is in a folder of its own."""
    folder = tmp_path_factory.mktemp("weights")
    design = MetricDesign((-9.0,) * 4, (9.0,) * 4, (1.0,) * 4, (-2.0,) * 2, (2.0,) * 2, rate=0.4)

    class Measured(Slide):
        """The puck with a metric."""

        name, title = "measured", "Measured"
        metric, weights = design, folder

    region = BoxRegion(
        design.low, design.high, design.error, design.control_low, design.control_high
    )
    made = design_on_region(
        SLIDE.system, region, CvStemSettings(contraction_rate=0.4, basis=CONSTANT), pool=200
    )
    samples = region.sample(np.random.default_rng(1), 500)
    save_metric(verify_metric(SLIDE.system, made, samples, 1), folder / "measured_metric.json")
    register_task(Measured())
    return Measured()


def test_a_certificate_of_flights_says_what_each_claim_is(measured: Slide, invoke: Any) -> None:
    result = invoke(
        *("certify", "measured", "--policy", "tube-mpc", "--bound", 0.05, "--episodes", 19),
        *("--json", "c.json"),
    )
    assert result.exit_code == 0, result.output
    found = json.loads(Path("c.json").read_text())
    kinds = {line["kind"] for line in found["statements"]}
    assert {"observed", "calibrated"} <= kinds
    assert found["tube"]["observed"] > 0.0
    # No metric flies, and Theorem 1 is about none of it.
    assert found["alpha"] is found["chi"] is found["metric"] is None
    assert any("Theorem 1" in line for line in found["not_proved"])


def test_a_certificate_of_a_metric_says_what_is_proved_of_it(measured: Slide, invoke: Any) -> None:
    result = invoke("certify", "measured", "--episodes", 0, "--json", "c.json")
    assert result.exit_code == 0, result.output
    assert "no tube is certified" in " ".join(result.stdout.split())
    found = json.loads(Path("c.json").read_text())
    kinds = [line["kind"] for line in found["statements"]]
    # The system is linear and the metric constant: the proof is one inequality.
    assert kinds.count("proved") == 2
    assert set(kinds) == {"proved", "observed"}
    assert len(found["not_proved"]) == 1
    assert found["guarantee"] is found["tube"]["certified"] is found["tube"]["observed"] is None
    assert found["policy"] == "u*"
    assert found["region"]["vx"] == [-9.0, 9.0]
    # I <= W_bar <= chi I.
    spectrum = np.linalg.eigvalsh(np.array(found["metric"]["coefficients"])[0])
    assert spectrum[[0, -1]].tolist() == pytest.approx([1.0, found["chi"]], rel=1e-6)
    texts = [line["text"] for line in found["statements"] if "<= W_bar <=" in line["text"]]
    least, largest = (float(end.split()[-1]) for end in texts[0].split(" I")[:2])
    assert least <= spectrum[0] <= spectrum[-1] <= largest


def test_a_metric_that_does_not_contract_makes_no_certificate(measured: Slide, invoke: Any) -> None:
    metric = Expert(measured).metric
    samples = metric.region.sample(np.random.default_rng(2), 500)
    fast = verify_metric(measured.system, replace(metric, contraction_rate=9.0), samples, 2)
    # What its file says of its check is not taken over: that may be of another system.
    save_metric(replace(fast, verification=metric.verification), "fast.json")
    result = invoke("certify", "measured", "--metric", "fast.json")
    assert result.exit_code == 1
    assert result.output.splitlines()[0].startswith("NOT every claim holds"), result.output


def test_the_expert_is_written_as_data(measured: Slide, invoke: Any) -> None:
    minari = pytest.importorskip("minari")
    arguments = (
        "data",
        "export",
        "--minari",
        "--task",
        "measured",
        "--episodes",
        2,
        "--bound",
        0.05,
    )
    result = invoke(*arguments, "--out", "sets")
    assert result.exit_code == 0, result.output
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(Path("sets").resolve()))
        data = minari.load_dataset("lagros/measured/expert-v0")
    env = gym.make(measured.env_id, disturbance="uniform", disturbance_bound=0.05)
    for episode in data.iterate_episodes():
        seed = data.storage.get_episode_metadata([episode.id])
        observation, _ = env.reset(seed=int(next(iter(seed))["seed"]))
        for action, seen in zip(episode.actions, episode.observations[1:], strict=True):
            observation = env.step(action)[0]
            np.testing.assert_array_equal(observation, seen)
        assert episode.infos["nominal_state"].shape == (len(episode.observations), 4)


# Learning by reinforcement


@pytest.mark.parametrize("name", ["ppo", "td3"])
def test_an_agent_learns_and_its_weights_fly(name: str, invoke: Any, monkeypatch: Any) -> None:
    pytest.importorskip("stable_baselines3")
    from lagros_benchmarks.training.course import SingleCourse, default_training
    from lagros_benchmarks.training.settings import Ppo, Td3

    algorithm: Any = Ppo(rollout_steps=20, batch_size=40, epochs=1, hidden=(8,))
    if name == "td3":
        algorithm = Td3(batch_size=16, warm_up=16, hidden=(8,), buffer_size=200)
    small = {"segment_steps": 20, "worlds": 4, "curve_episodes": 5, "final_episodes": 5}
    tiny = replace(default_training("slider", name), algorithm=algorithm, **small)
    assert tiny.disturbance_bound == 0.1
    monkeypatch.setattr(SingleCourse, "trainings", lambda *_: {name: tiny})
    files = ("--json", "curves.json", "--figure", "curves.png")
    result = invoke("train", FILE, "--algo", name, "--segments", 2, "--out", "runs", *files)
    assert result.exit_code == 0, result.output
    assert "coll." in result.output
    folder = Path("runs") / f"slider-{name}" / "seed-0"
    env = gym.make(SLIDE.env_id, disturbance="uniform", disturbance_bound=0.1)
    policy = lagros_policies.make(name, env, weights=folder / "weights.safetensors")
    seeds = episode_seeds(0, 5, FINAL)
    record = json.loads((folder / "record.json").read_text())
    efforts, collided = [], []
    for seed in seeds:
        observation, info = env.reset(seed=seed)
        over = False
        while not over:
            action, _ = policy.predict(observation)
            observation, _, terminated, truncated, info = env.step(action)
            over = terminated or truncated
        efforts.append(info["effort"])
        collided.append(info["collided"])
    told = record["final"][1]
    assert told["effort"] == pytest.approx(np.mean(efforts), rel=1e-3, abs=6e-5)
    assert told["collided"] == pytest.approx(np.mean(collided))


def test_a_zip_of_stable_baselines3_flies(invoke: Any) -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    env = gym.make(SLIDE.env_id)
    sb3.PPO("MlpPolicy", env, n_steps=8, batch_size=8, device="cpu").save("agent.zip")
    result = invoke("watch", FILE, "--policy", "agent.zip", "--seconds", 1, "--video", "a.gif")
    assert result.exit_code == 0, result.output
    assert "agent.zip on seed 0" in result.output


def test_a_run_of_a_correction_is_one_folder_whatever_the_unit() -> None:
    from lagros_benchmarks.training.course import default_training

    run = replace(default_training("slider", "td3"), largest_correction=1.5)
    assert run.described.control_unit == "m/s^2"
    assert run.label == "residual-td3-1.5ms2"

"""Training runs: their settings, agents and worlds, and what they resume from."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from stable_baselines3.common.vec_env import VecNormalize

from lagros_benchmarks.run.settings import BenchmarkSettings
from lagros_benchmarks.training import evaluation, single
from lagros_benchmarks.training.agent import make_agent
from lagros_benchmarks.training.course import course_of, default_training, lesson_of
from lagros_benchmarks.training.run import Place, train
from lagros_benchmarks.training.sb3_vector import SB3VectorEnv
from lagros_benchmarks.training.settings import (
    CURVE,
    FINAL,
    OffPolicy,
)
from lagros_benchmarks.training.single import SingleLesson
from lagros_envs.registry import find_task, task_names
from lagros_envs.seeding import EVALUATION, episode_seeds
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_envs.tasks.cartpole.vector import CartPoleVectorEnv
from lagros_policies.actor import Actor, ActorPolicy
from lagros_policies.lagros import LagrosPolicy
from lagros_policies.learning.networks import Mlp
from lagros_policies.residual import ResidualPolicy
from tests.benchmarks.tiny_training import ALGORITHMS, TINY, one_thread


@pytest.fixture(autouse=True)
def threads():
    yield from one_thread()


def run(training, folder, **options):
    return train(training, Place(folder, **options), lambda: lesson_of(training), "a command")


# Settings


@pytest.mark.parametrize(
    "change",
    [
        {"segments": 0},
        {"segments": 1 << 16},
        {"worlds": 1.5},
        {"seed": -1},
        {"seed": 1 << 32},
        {"segment_steps": 13},
        {"largest_correction": 0.0},
        {"largest_correction": float("inf")},
    ],
)
def test_runs_that_make_no_sense_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        replace(TINY, **change)


@pytest.mark.parametrize(
    ("algorithm", "change"),
    [("ppo", {"epochs": 0}), ("ppo", {"clip_range": 0.0}), ("sac", {"averaging": -1.0})],
)
def test_hyperparameters_that_make_no_sense_are_refused(algorithm, change):
    with pytest.raises(ValueError, match=next(iter(change))):
        replace(ALGORITHMS[algorithm], **change)


def test_every_default_can_be_built_and_written_down():
    for task in task_names():
        for name, training in course_of(find_task(task)).trainings(find_task(task)).items():
            assert default_training(task, name) == training
            assert training.record()["algorithm"]["name"] == name
            json.dumps(training.record(), allow_nan=False)
            if isinstance(training.algorithm, OffPolicy):
                # Nothing that was met is forgotten.
                whole = training.segments * training.steps_of_segment
                assert training.algorithm.buffer_size >= whole
    with pytest.raises(ValueError, match="Did you mean 'ppo'"):
        default_training("cartpole", "pppo")
    with pytest.raises(ValueError, match="Did you mean 'cartpole'"):
        default_training("cartpoles", "ppo")


def test_no_episode_of_training_or_its_figures_is_one_of_the_benchmark():
    benchmark = set(BenchmarkSettings(episodes=2000).episode_seeds())
    assert benchmark.isdisjoint(episode_seeds(0, 2000, CURVE))
    assert benchmark.isdisjoint(episode_seeds(0, 2000, FINAL))
    assert set(episode_seeds(0, 2000, CURVE)).isdisjoint(episode_seeds(0, 2000, FINAL))
    # The streams of the segments are namespaces of the run's seed.
    starts = {
        tuple(np.random.SeedSequence(0, spawn_key=(key,)).generate_state(4))
        for key in (*range(1000), EVALUATION, CURVE, FINAL)
    }
    assert len(starts) == 1003


def test_the_figures_are_of_episodes_that_neither_training_nor_the_benchmark_meets(monkeypatch):
    training = replace(TINY, curve_episodes=40, final_episodes=50)
    lesson = SingleLesson(training)
    flown = []

    def spy(policy, seeds, *condition):
        flown.append((seeds, *condition))
        return {"success": 0.8}

    for module in (single, evaluation):
        monkeypatch.setattr(module, "evaluate", spy)
    model = make_agent(training, lesson.venv)
    lesson.figures(model)
    rows = lesson.final(model)
    curve, final = episode_seeds(0, 40, CURVE), episode_seeds(0, 50, FINAL)
    assert flown == [(curve, "uniform", 0.75), (final, "none", 0.0), (final, "uniform", 0.75)]
    # Wilson's interval of 40 of 50.
    assert rows[1]["success_ci95"] == [0.6696, 0.8876]


@pytest.mark.parametrize("correction", [None, 4.0])
@pytest.mark.parametrize("name", ["ppo", "td3"])
def test_the_worlds_in_training_are_those_of_the_settings(name, correction):
    algorithm = replace(ALGORITHMS[name], discount=0.97)
    task = {"effort_weight": 0.7, "disturbance": "sphere", "disturbance_bound": 0.3}
    training = replace(TINY, algorithm=algorithm, largest_correction=correction, **task)
    venv = SingleLesson(training).venv
    disturbance, settings = venv.get_attr("disturbance")[0], venv.get_attr("settings")[0]
    assert (disturbance.kind, disturbance.bound) == ("sphere", 0.3)
    assert settings == CartPoleSettings(effort_weight=0.7)
    assert venv.num_envs == training.worlds
    # Returns are normalised over the agent's own horizon; those of a buffer are not.
    assert getattr(venv, "gamma", None) == (0.97 if name == "ppo" else None)


def test_the_agent_has_the_hyperparameters_of_the_settings():
    made = {}
    for name, change in (
        ("ppo", {"gae_decay": 0.9, "clip_range": 0.3, "initial_log_std": -1.2}),
        ("sac", {"averaging": 0.03, "initial_entropy_weight": 0.2}),
        ("td3", {"averaging": 0.04, "action_noise": 0.3, "policy_delay": 3}),
    ):
        algorithm = replace(ALGORITHMS[name], **change)
        training = replace(TINY, algorithm=algorithm, seed=5)
        model = made[name] = make_agent(training, SingleLesson(training).venv)
        assert (model.gamma, model.seed) == (algorithm.discount, 5)
        assert model.batch_size == algorithm.batch_size
        assert [len(bias) for bias in single.actor_network(model).biases] == [8, 1]
        if isinstance(algorithm, OffPolicy):
            assert model.replay_buffer.buffer_size == algorithm.buffer_size // TINY.worlds
            assert (model.learning_starts, model.gradient_steps) == (64, 3)
            assert model.tau == algorithm.averaging
    ppo, sac, td3 = made.values()
    assert (ppo.n_steps, ppo.n_epochs, ppo.gae_lambda) == (12, 2, 0.9)
    assert ppo.clip_range(1.0) == 0.3
    assert ppo.policy.log_std.item() == pytest.approx(-1.2)
    assert sac.log_ent_coef.exp().item() == pytest.approx(0.2)
    assert td3.policy_delay == 3
    assert np.std([td3.action_noise()[0] for _ in range(4000)]) == pytest.approx(0.3, rel=0.05)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_what_is_kept_of_a_correction_is_what_flew_in_training(name, tmp_path):
    training = replace(TINY, algorithm=ALGORITHMS[name], largest_correction=3.0)
    lesson = SingleLesson(training)
    if isinstance(lesson.venv, VecNormalize):
        lesson.venv.training = False  # the running mean is fixed at the export
    model = make_agent(training, lesson.venv)
    lesson.save(model, tmp_path / "a.safetensors")
    policy = ResidualPolicy(weights=tmp_path / "a.safetensors")
    assert policy.largest_correction == 3.0
    applied = []
    worlds = lesson.venv.unwrapped
    while not isinstance(worlds, SB3VectorEnv):
        worlds = worlds.venv
    step = worlds.step_async
    worlds.step_async = lambda actions: applied.append(np.array(actions)) or step(actions)
    lesson.venv.seed(1)
    seen = lesson.venv.reset()
    flown = CartPoleVectorEnv(TINY.worlds, "uniform", autoreset_mode="same_step")
    rows, _ = flown.reset(seed=1)
    for _ in range(5):
        seen, *_ = lesson.venv.step(model.predict(seen, deterministic=True)[0])
        expected = policy.predict(rows)[0]
        np.testing.assert_allclose(applied[-1], expected, atol=2e-5)
        rows, *_ = flown.step(expected)
    # No agent that did nothing would pass.
    assert np.abs(applied[-1] - LagrosPolicy().predict(rows)[0]).max() > 1e-4


def test_the_learning_rate_falls_by_segments_to_a_tenth(tmp_path, monkeypatch):
    models = []

    def keep(training, venv):
        models.append(make_agent(training, venv))
        return models[-1]

    monkeypatch.setattr("lagros_benchmarks.training.run.make_agent", keep)
    rates = [TINY.learning_rate(segment) for segment in range(3)]
    np.testing.assert_allclose(rates, [3e-4, 2.1e-4, 1.2e-4])
    assert replace(TINY, segments=1000).learning_rate(999) == pytest.approx(3e-5, rel=0.01)
    run(TINY, tmp_path)
    assert models[0].policy.optimizer.param_groups[0]["lr"] == rates[-1]


# Runs


@pytest.mark.parametrize("correction", [None, 4.0])
@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_run_that_was_killed_ends_with_the_same_weights(name, correction, tmp_path, monkeypatch):
    training = replace(TINY, algorithm=ALGORITHMS[name], largest_correction=correction)
    whole = run(training, tmp_path / "whole")
    calls = []
    evaluate = single.evaluate

    def killed(*arguments):
        calls.append(arguments)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return evaluate(*arguments)

    monkeypatch.setattr(single, "evaluate", killed)
    folder = tmp_path / "cut"
    with pytest.raises(KeyboardInterrupt):
        run(training, folder)
    assert [path.name for path in folder.iterdir()] == ["checkpoint.pt"]
    cut = run(training, folder)
    file = "weights.safetensors"
    assert (folder / file).read_bytes() == (tmp_path / "whole" / file).read_bytes()
    for record in (whole, cut):
        assert record["curve"]["steps"] == [192, 384, 576]
        del record["curve"]["seconds"], record["curve"]["cpu_seconds"]
    assert cut["curve"] == whole["curve"]
    assert cut["final"] == whole["final"]
    assert sorted(path.name for path in folder.iterdir()) == ["record.json", "weights.safetensors"]
    # A complete run is read and not run again.
    again = train(training, Place(folder), lambda: pytest.fail("it was complete"))
    assert again["final"] == whole["final"]


@pytest.mark.parametrize("how", ["gone", "empty", "truncated", "of another run", "a folder"])
def test_a_run_without_its_weights_is_made_again(tmp_path, how):
    training = replace(TINY, segments=1)
    whole = run(training, tmp_path / "run")
    weights = tmp_path / "run" / "weights.safetensors"
    content = weights.read_bytes()
    assert hashlib.sha256(content).hexdigest() == whole["weights_sha256"]
    weights.unlink()
    if how == "of another run":
        run(replace(training, seed=1), tmp_path / "other")
        weights.write_bytes((tmp_path / "other" / "weights.safetensors").read_bytes())
    elif how == "a folder":
        weights.mkdir()
        with pytest.raises(OSError, match="folder"):
            run(training, tmp_path / "run")
        weights.rmdir()
    elif how != "gone":
        weights.write_bytes(content[: {"empty": 0, "truncated": -10}[how]])
    again = run(training, tmp_path / "run")
    assert again["final"] == whole["final"]
    assert weights.read_bytes() == content
    train(training, Place(tmp_path / "run"), lambda: pytest.fail("it was complete"))


def test_the_folder_of_another_run_is_refused(tmp_path, monkeypatch):
    folder = tmp_path / "run"
    monkeypatch.setattr(SingleLesson, "final", lambda *_: pytest.fail("too far"))
    with pytest.raises(pytest.fail.Exception):
        run(TINY, folder)
    other = replace(TINY, seed=1)
    differs = r"holds another run \(seed is 0 there and 1 here\)"
    with pytest.raises(ValueError, match=differs):
        run(other, folder)
    checkpoint = folder / "checkpoint.pt"
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    with pytest.raises(ValueError, match="is damaged"):
        run(TINY, folder)
    (folder / "record.json").write_text(json.dumps({"training": other.record()}))
    with pytest.raises(ValueError, match=r"seed is 1 there and 0 here\); delete it"):
        run(TINY, folder)
    (folder / "record.json").write_text('{"training": []}')
    with pytest.raises(ValueError, match=r"record\.json: 'training' must be an object"):
        run(TINY, folder)
    (folder / "record.json").write_text("{")
    with pytest.raises(ValueError, match=r"record\.json is not the record of a run"):
        run(TINY, folder)


def test_the_record_says_what_the_weights_depend_on(tmp_path):
    training = replace(TINY, segments=1, algorithm=ALGORITHMS["sac"])
    record = run(training, tmp_path)
    assert record == json.loads((tmp_path / "record.json").read_text())
    assert record["command"] == "a command"
    assert record["training"]["algorithm"]["gradient_steps"] == 3
    assert record["training"]["disturbance_bound"] == 0.75
    assert {"torch", "stable-baselines3", "numpy"} <= set(record["versions"])
    assert [row["disturbance"] for row in record["final"]] == ["none", "uniform"]
    actor = Actor.load(tmp_path / "weights.safetensors")
    assert actor.squash == "tanh"
    assert (actor.metadata["task"], actor.metadata["policy"]) == ("cartpole", "sac")
    said = json.loads(actor.metadata["trained_for"])
    assert said["equal"]["control_period"] == 0.1
    assert said["at_most"]["time_limit"] == 9.0
    figures = single.evaluate(
        ActorPolicy(weights=actor), episode_seeds(0, 6, FINAL), "uniform", 0.75
    )
    assert figures["effort"] == pytest.approx(record["final"][1]["effort"], abs=1e-4)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_events_hold_the_curve_once_also_after_a_kill(tmp_path, monkeypatch):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    training = replace(TINY, algorithm=ALGORITHMS["td3"])
    saved = []
    save = SingleLesson.figures

    def killed_once(lesson, model):
        figures = save(lesson, model)
        saved.append(figures)
        return figures

    monkeypatch.setattr(SingleLesson, "figures", killed_once)
    from lagros_benchmarks.training import run as run_module

    write = run_module._save

    def dies(path, settings, model, curve):
        if len(saved) == 2:
            saved.append(None)
            raise KeyboardInterrupt  # after the events of the segment, before its checkpoint
        write(path, settings, model, curve)

    monkeypatch.setattr(run_module, "_save", dies)
    with pytest.raises(KeyboardInterrupt):
        run(training, tmp_path, tensorboard=True)
    record = run(training, tmp_path, tensorboard=True)
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    written = events.Scalars("evaluation/effort")
    assert [event.step for event in written] == record["curve"]["steps"]
    assert [event.value for event in written] == pytest.approx(record["curve"]["effort"])
    assert any(name.startswith("train/") for name in events.Tags()["scalars"])


@pytest.mark.slow
def test_a_process_that_is_killed_for_good_goes_on(tmp_path):
    program = (
        "import sys; sys.argv = ['lagros', 'train', 'cartpole', '--algo', 'td3', "
        "'--segments', '3', '--out', sys.argv[1]]; "
        "from lagros_benchmarks.commands.cli import app; app()"
    )

    def start(folder):
        return subprocess.Popen([sys.executable, "-c", program, str(folder)])

    assert start(tmp_path / "whole").wait(timeout=280) == 0
    process = start(tmp_path / "cut")
    checkpoint = tmp_path / "cut" / "cartpole-td3" / "seed-0" / "checkpoint.pt"
    while not checkpoint.exists():
        assert process.poll() is None
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not checkpoint.with_name("record.json").exists()
    assert start(tmp_path / "cut").wait(timeout=280) == 0
    weights = "cartpole-td3/seed-0/weights.safetensors"
    assert (tmp_path / "cut" / weights).read_bytes() == (tmp_path / "whole" / weights).read_bytes()


# The cart-pole


def test_the_corrected_worlds_are_moved_by_both():
    settings = CartPoleSettings()
    worlds = CartPoleVectorEnv(5, "uniform", settings=settings, autoreset_mode="same_step")
    env = single.CorrectedWorlds(
        SB3VectorEnv(worlds), LagrosPolicy(settings), 4.0, settings.control_scale
    )
    plain = CartPoleVectorEnv(5, "uniform", settings=settings, autoreset_mode="same_step")
    env.seed(3)
    ours = env.reset()
    theirs, _ = plain.reset(seed=3)
    rng = np.random.default_rng(0)
    base = LagrosPolicy(settings)
    for _ in range(100):  # past the end of the episodes
        np.testing.assert_allclose(ours, theirs, atol=1e-5)
        correction = rng.uniform(-2.0, 2.0, (5, 1)).astype(np.float32)
        force = settings.force_scale * base.predict(theirs)[0] + 4.0 * np.clip(correction, -1, 1)
        ours, reward, _, _ = env.step(correction)
        theirs, expected, *_ = plain.step(force / settings.force_scale)
        np.testing.assert_allclose(reward, expected, rtol=1e-4, atol=1e-4)
    with pytest.raises(RuntimeError, match="reset"):
        single.CorrectedWorlds(SB3VectorEnv(worlds), base, 4.0, (40.0,)).step_async(
            np.zeros((5, 1))
        )


def test_the_figures_count_what_happens_before_the_first_fall():
    class Never(ActorPolicy):
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return np.zeros((len(observation), 1), np.float32), state

    actor = Actor(
        network=Mlp([np.zeros((4, 1))], [np.zeros(1)]),
        features=np.eye(4, 13, dtype=np.float32),
        mean=np.zeros(4, np.float32),
        std=np.ones(4, np.float32),
        feature_clip=1.0,
        action_clip=1.0,
        control_scale=(40.0,),
    )
    figures = single.evaluate(Never(weights=actor), episode_seeds(1, 50), "none", 0.0)
    assert figures["fallen"] == 1.0
    assert figures["strict"] == 0.0
    assert figures["effort"] == 0.0
    assert figures["success"] < 0.5

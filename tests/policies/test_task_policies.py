"""Policies of any task of one body, on tasks that no package knows; and all of all tasks."""

import math
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
import pytest
import scipy.linalg
from stable_baselines3 import PPO

from lagros_envs.env import TaskEnv
from lagros_envs.registry import called, task_named
from lagros_envs.seeding import episode_seeds
from lagros_envs.task import Scenario, Task
from lagros_envs.tasks import SHIPPED
from lagros_envs.vector import TaskVectorEnv
from lagros_policies import make
from lagros_policies.actor import Actor, ActorPolicy, goal_frame
from lagros_policies.baselines import LqrPolicy, RandomPolicy
from lagros_policies.contraction import BoxRegion, CvStemSettings, design_on_region
from lagros_policies.contraction.basis import harmonics
from lagros_policies.learning.networks import Mlp
from lagros_policies.policy import BasePolicy, Policy, policy_names
from lagros_policies.room import found_file, shipped_file, weights_folder
from lagros_policies.sb3_model import StableBaselines3Policy
from lagros_policies.trained_for import check_weights, training_of, weights_record
from lagros_policies.tube_mpc import TubeMpcPolicy
from tests.policies.toys import Drive, Slide


@pytest.fixture(scope="module")
def metrics():
    slide = BoxRegion((-9.0,) * 4, (9.0,) * 4, (0.5,) * 4, (-3.0,) * 2, (3.0,) * 2)
    drive = BoxRegion(
        (-9.0, -9.0, -1.0, 1.0), (9.0, 9.0, 1.0, 2.0), (0.3,) * 4, (-1.5, -0.5), (1.5, 0.5)
    )
    settings = CvStemSettings(0.5, 0, 0.05, 0.1, (1.0,) * 4)
    turned = replace(settings, basis=harmonics(2, 1), point="nominal")
    return {
        "slide": design_on_region(Slide().system, slide, settings, seed=1),
        "drive": design_on_region(Drive().system, drive, turned, seed=1),
    }


def flown(task, policy, count, bound, seed=0):
    """Return the share of episodes that succeed, and what was counted."""
    env = TaskEnv(task=task, disturbance="uniform", disturbance_bound=bound)
    won, counters = 0, {}
    for episode in episode_seeds(seed, count, 7):
        observation, info = env.reset(seed=episode)
        memory, over, first = None, False, True
        while not over:
            action, memory = policy.predict(observation, memory, np.array([first]))
            observation, _, fallen, late, info = env.step(action)
            over, first = fallen or late, False
        won += info["success"]
        for name, number in policy.counters(memory).items():
            counters[name] = counters.get(name, 0) + number
    return won / count, counters


# Tube MPC


@pytest.mark.parametrize("task", [Slide(), Drive()], ids=lambda task: task.name)
def test_tube_mpc_brings_a_task_of_anybodys_to_its_goal(task, metrics):
    policy = TubeMpcPolicy(task, metrics[task.name], replan_every=20, deadline=1e9)
    success, counters = flown(task, policy, 50, 0.3)
    assert success >= 0.96
    assert counters["plans"] == 100
    assert counters["failed_plans"] == 0


def test_a_batch_of_worlds_is_its_worlds(metrics):
    task = Slide()
    worlds = TaskVectorEnv(3, task=task, disturbance="none", autoreset_mode="disabled")
    rows, _ = worlds.reset(seed=[1, 2, 3])
    policy = TubeMpcPolicy(task, metrics["slide"], deadline=1e9)
    together, memories = policy.predict(rows)
    assert together.shape == (3, 2)
    assert policy.counters(memories) == {
        "plans": 3,
        "failed_plans": 0,
        "late_plans": 0,
        "saturated_steps": 0,
    }
    for row, action in zip(rows, together, strict=True):
        np.testing.assert_array_equal(policy.predict(row)[0], action)


def test_it_plans_again_where_a_disc_moves(metrics):
    task = Slide()
    env = TaskEnv(task=task)
    discs = [[2.0, 0.5, 0.3]]
    row, _ = env.reset(
        options={"initial_state": [0, 0, 0, 0], "goal": [4, 0, 0, 0], "discs": discs}
    )
    policy = TubeMpcPolicy(task, metrics["slide"], replan_every=100, deadline=1e9)
    _, memory = policy.predict(row)
    row = row.copy()
    row[task.layout.time] = 0.1
    _, memory = policy.predict(row, memory)
    assert policy.counters(memory)["plans"] == 1
    row[task.layout.discs] = [2.0, -0.5, 0.3, 0.0, 0.0, 0.0]
    before = memory[0].plan
    _, memory = policy.predict(row, memory)
    assert policy.counters(memory)["plans"] == 2
    halfway = memory[0].plan.states[20]
    assert np.linalg.norm(halfway[:2] - [2.0, -0.5]) >= 0.6 - 1e-6
    assert np.linalg.norm(before.states[20][:2] - [2.0, -0.5]) < np.linalg.norm(
        halfway[:2] - [2.0, -0.5]
    )


def test_without_a_plan_the_control_is_that_of_reference(metrics):
    @dataclass(frozen=True)
    class Weak(Slide):
        control_low, control_high = (-0.05, -0.05), (0.05, 0.05)

        @property
        def control_centre(self):
            return (0.01, 0.0)

    policy = TubeMpcPolicy(Weak(), metrics["slide"], deadline=1e9)
    row, _ = TaskEnv(task=Weak()).reset(seed=0)
    action, memory = policy.predict(row)
    assert policy.counters(memory)["failed_plans"] == 1
    assert action.tolist() == [0.0, 0.0]


def test_another_system_needs_another_metric(metrics, tmp_path):
    from lagros_policies.contraction.metric_files import save_metric

    task = type("Kept", (Slide,), {"weights": tmp_path})
    save_metric(metrics["slide"], tmp_path / "slide_metric.json")
    assert TubeMpcPolicy(task(), law="least-norm").settings.name == "slide"
    heavy = replace(task(), system=replace(task().system, mass=2.0))
    with pytest.raises(
        ValueError, match=r"system\.mass=2\.0: the shipped metric was made for 1\.0"
    ):
        TubeMpcPolicy(heavy, law="least-norm")
    allowed = TubeMpcPolicy(heavy, law="least-norm", allow_other_settings=True)
    assert allowed.settings.system.mass == 2.0
    # The law along a plan has its metric from the plan, of whatever system that is.
    assert TubeMpcPolicy(heavy).settings.system.mass == 2.0


# The regulator


def test_the_regulator_is_that_of_the_matrix_exponential():
    task = Slide()
    policy = LqrPolicy(task, state_weights=[3.0, 2.0, 1.0, 0.5], control_weights=[0.2, 0.4])
    a = np.zeros((6, 6))
    a[0, 2] = a[1, 3] = a[2, 4] = a[3, 5] = 1.0
    a[2, 2] = a[3, 3] = -0.2
    held = scipy.linalg.expm(task.control_period * a)
    A, B, Q, R = held[:4, :4], held[:4, 4:], np.diag([3.0, 2.0, 1.0, 0.5]), np.diag([0.2, 0.4])
    P = scipy.linalg.solve_discrete_are(A, B, Q, R)
    gain = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    np.testing.assert_allclose(policy.gain, gain, rtol=1e-5)
    rows = np.zeros((2, task.layout.size))
    rows[:, :4], rows[:, 4:8] = [[1.0, 0, 0, 0], [0, 1.0, 2.0, 0]], [4.0, 0, 0, 0]
    expected = -(rows[:, :4] - rows[:, 4:8]) @ gain.T / 2.0
    np.testing.assert_allclose(policy.predict(rows)[0], expected, rtol=1e-5)
    np.testing.assert_allclose(policy.predict(rows[1])[0], expected[1], rtol=1e-5)


def test_a_goal_that_no_control_holds_is_followed_as_it_moves():
    task = Drive()
    policy = LqrPolicy(task)
    heading, speed = 0.3, 1.5
    goal = np.array([6.0, 1.0, heading, speed])
    way = speed * np.array([math.cos(heading), math.sin(heading)])
    row = np.zeros(task.layout.size)
    row[task.layout.goal] = goal
    for step in (0, 13, 40):
        left = task.time_limit - 0.1 * step
        row[task.layout.time] = 0.1 * step
        row[task.layout.state] = [*(goal[:2] - left * way), heading, speed]
        np.testing.assert_allclose(policy.predict(row)[0], 0.0, atol=1e-6)
    row[0] += 0.5 * math.cos(heading + math.pi / 2)
    row[1] += 0.5 * math.sin(heading + math.pi / 2)
    turn, push = policy.predict(row)[0]
    assert turn < -0.05
    assert push == pytest.approx(0.0, abs=1e-6)
    batch, _ = policy.predict(np.stack([row, row]))
    np.testing.assert_allclose(batch[1], [turn, push], rtol=1e-6)


def test_what_the_controls_cannot_stabilise_is_refused_by_name():
    class Parking(Drive):
        def sample(self, rng):
            return Scenario(np.zeros(4), np.array([3.0, 1.0, 0.0, 0.0]))

    with pytest.raises(ValueError, match=r"lqr of drive: the controls cannot stabilise the system"):
        LqrPolicy(Parking())


@dataclass(frozen=True)
class Lift:
    """[height, speed] under a thrust, with gravity."""

    state_dim: int = 2
    control_dim: int = 1

    def derivative(self, state, control, functions):
        return state[1], control[0] - 9.81


@dataclass(frozen=True)
class Hoist(Task):
    system: Lift = field(default_factory=Lift)
    time_limit: float = 8.0
    name, title = "hoist", "Hoist"
    control_scale: ClassVar = (2.0,)

    def sample(self, rng):
        return Scenario(np.zeros(2), np.array([rng.uniform(0.5, 1.5), 0.0]))


def test_a_goal_is_held_by_the_control_that_it_needs():
    task = Hoist()
    policy = LqrPolicy(task)
    row = np.zeros(task.layout.size)
    row[task.layout.state] = row[task.layout.goal] = [1.0, 0.0]
    assert policy.predict(row)[0] == pytest.approx([9.81 / 2.0])
    assert flown(task, policy, 5, 0.0)[0] == 1.0


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ({"state_weights": [1.0] * 3}, r"state_weights=.* must be 4 finite numbers >= 0"),
        ({"control_weights": [1.0, 0.0]}, r"control_weights=.* must be 2 finite numbers > 0"),
        ({"control_weights": math.inf}, r"control_weights=.* must be 2 finite numbers"),
        ({"state_weights": [0.0, 1.0, 1.0, 1.0]}, r"state_weights=.* must be > 0 for a coordinate"),
    ],
)
def test_weights_without_a_gain_are_refused_by_name(weights, message):
    with pytest.raises(ValueError, match=message):
        LqrPolicy(Slide(), **weights)


def test_random_actions_have_the_shape_of_the_task():
    policy = RandomPolicy(Slide(), seed=3)
    action, memory = policy.predict(np.zeros((500, Slide().layout.size)), "memory")
    assert action.shape == (500, 2)
    assert memory == "memory"
    assert 0.9 < np.max(action) <= 1.0
    assert -1.0 <= np.min(action) < -0.9
    with pytest.raises(ValueError, match=r"must be \(19,\), or \(B, 19\)"):
        policy.predict(np.zeros(13))


# Actors and models


def actor_of(task, scale=(2.0, 2.0)):
    frame = goal_frame(task).astype(np.float32)
    rng = np.random.default_rng(0)
    count = len(frame)
    network = Mlp(
        [rng.standard_normal((count, 8)) / 4.0, rng.standard_normal((8, 2))],
        [np.zeros(8), np.zeros(2)],
    )
    zero, one = np.zeros(count, np.float32), np.ones(count, np.float32)
    record = weights_record("slide", "ppo", training_of(task).range(timed=False))
    return Actor(network, frame, zero, one, 10.0, 1.0, scale, metadata=record)


def test_an_actor_flies_the_task_of_its_training(tmp_path):
    task = Slide()
    frame = goal_frame(task)
    row = np.arange(1.0, 1.0 + task.layout.size)
    np.testing.assert_allclose((frame @ row)[:4], row[:4] - row[4:8])
    np.testing.assert_allclose((frame @ row)[4:7], row[13:16] - [row[0], row[1], 0.0])
    actor_of(task).save(tmp_path / "slide_ppo.safetensors")
    kept = type("Kept", (Slide,), {"weights": tmp_path})()
    policy = make("ppo", TaskEnv(task=kept))
    rows = np.random.default_rng(1).standard_normal((5, task.layout.size)).astype(np.float32)
    features = rows @ frame.T.astype(np.float32)
    weights, biases = policy.actor.network.weights, policy.actor.network.biases
    by_hand = np.tanh(features @ weights[0] + biases[0]) @ weights[1] + biases[1]
    expected = np.clip(by_hand, -1.0, 1.0)
    np.testing.assert_allclose(policy.predict(rows)[0], expected, rtol=1e-5, atol=1e-6)
    half = ActorPolicy(task, replace(actor_of(task), control_scale=(1.0, 4.0)))
    np.testing.assert_allclose(half.predict(rows)[0], expected * [0.5, 2.0], rtol=1e-5, atol=1e-6)
    with pytest.raises(ValueError, match=r"time_limit=2\.0: .* was made for 4\.0"):
        ActorPolicy(replace(task, time_limit=2.0), actor_of(task))
    with pytest.raises(ValueError, match=r"maps observations of 19 numbers to actions of 2; those"):
        ActorPolicy(Drive(), replace(actor_of(task), metadata={}), allow_other_settings=True)
    with pytest.raises(ValueError, match="holds the policy 'ppo' of the slide, not"):
        ActorPolicy(Drive(), actor_of(task))


def test_a_model_of_stable_baselines3_flies_its_task():
    env = TaskEnv(task=Slide())
    model = PPO("MlpPolicy", env, policy_kwargs={"net_arch": [8]}, device="cpu", seed=0)
    policy = StableBaselines3Policy(model, "mine", Slide())
    row, _ = env.reset(seed=0)
    np.testing.assert_array_equal(policy.predict(row)[0], model.predict(row, deterministic=True)[0])
    with pytest.raises(ValueError, match=r"lagros/Drive-v0 has \(16,\) and \(2,\)"):
        StableBaselines3Policy(model, "mine", Drive())


# What was trained for what


def test_all_settings_of_a_task_are_those_of_the_training():
    task = Slide()
    record = weights_record("slide", "mine", training_of(task).range(timed=True))
    policy = type("Mine", (BasePolicy,), {"name": "mine", "recorded_as": "mine"})()
    check = check_weights(task, record, "weights", policy, timed=True)
    check(np.zeros(task.layout.size))
    for other, name in (
        (replace(task, control_period=0.2), "control_period=0.2"),
        (replace(task, system=replace(task.system, friction=0.5)), "system.friction=0.5"),
    ):
        with pytest.raises(ValueError, match=name):
            check_weights(other, record, "weights", policy, timed=True)
        check_weights(other, record, "weights", policy, True, allow_other_settings=True)
        with pytest.raises(ValueError, match=name):  # without a record, the defaults are meant
            check_weights(other, {}, "weights", policy, timed=True)


@pytest.mark.parametrize(
    ("weights", "command"),
    [
        (None, "`lagros reproduce tests.policies.toys:Slide` makes it"),
        ("made here", "`lagros reproduce tests.policies.toys:Slide --out 'made here'` makes it"),
    ],
)
def test_what_reproduce_makes_is_where_policies_look(weights, command, monkeypatch, tmp_path):
    """Of a task of a user's own; those of the package have their files there."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Slide, "weights", weights)
    for what in ("metric.json", "lagros.safetensors"):
        with pytest.raises(FileNotFoundError, match="slide has no slide_") as caught:
            found_file(Slide(), what)
        assert str(caught.value).endswith(command)
    with pytest.raises(
        FileNotFoundError, match=r"`lagros train .*Slide --algo sac` makes it, to be"
    ):
        make("sac", TaskEnv(task=Slide()))
    folder = tmp_path / (weights or "runs/reproduce-slide")
    folder.mkdir(parents=True)
    # As in the folder of a run, and under the name that a file beside others has.
    for name in ("metric.json", "slide_metric.json", "slide_lagros.safetensors"):
        (folder / name).touch()
        found = shipped_file(Slide(), name.removeprefix("slide_"))
        assert found.resolve() == folder / name
    for name in SHIPPED:
        assert weights_folder(task_named(name)).is_absolute()


# All policies of all tasks


EVERY = [(task, name) for task in SHIPPED for name in policy_names(task_named(task))]


@pytest.mark.parametrize(("task", "name"), EVERY)
def test_every_policy_of_every_task_can_be_asked_everything(task, name):
    env, missing = task_named(task).env_id, ""
    try:
        policy = make(name, env)
    except FileNotFoundError as error:
        missing = str(error)
    if missing:
        commands = (f"`lagros {name} {called(task_named(task))}" for name in ("reproduce", "train"))
        assert any(command in missing for command in commands)
        return
    assert isinstance(policy, BasePolicy)
    assert isinstance(policy, Policy)
    assert policy.name == name
    assert policy.observes in ("local", "global")
    assert policy.bare is policy
    assert policy.draws in (True, False)
    policy.reseed(np.random.default_rng(0))
    features = policy.example_features()
    assert features is None or np.all(np.isfinite(policy.bare_forward(features)))


def test_the_old_names_of_a_task_are_found_with_a_warning():
    import lagros_policies.policy as module

    with pytest.warns(DeprecationWarning, match="has moved to"):
        names = module.SPACECRAFT_NAMES
    assert names == policy_names(task_named("spacecraft"))

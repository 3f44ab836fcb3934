"""What any task's networks see, and the flights of DAgger, against definition and environment."""

import pickle
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import pytest

from lagros_envs import register_task
from lagros_envs.numbers import Dual, functions
from lagros_envs.registry import find_task
from lagros_envs.task import Learning, Scenario
from lagros_envs.tasks.pvtol.task import PvtolSettings
from lagros_policies.export.single import example_observations
from lagros_policies.learning.dataset import ExpertDataSettings, generate
from lagros_policies.learning.features import RecordedView, Seen, moved, seen, view_of
from lagros_policies.learning.metric import MetricSettings, metric_settings
from lagros_policies.learning.network_policy import NetworkPolicy
from lagros_policies.learning.networks import Mlp
from lagros_policies.learning.rounds import flown, met_states
from tests.found import SINGLE_BODY, named, task_of
from tests.policies.toys import Drive, Slide


def episodes_of(task, count, first=0):
    return [task.sample(np.random.default_rng(seed)) for seed in range(first, first + count)]


def a_network(task, seed=0, size=0.3):
    """Return a network that does something."""
    rng = np.random.default_rng(seed)
    inputs, outputs = len(view_of(task).names), task.system.control_dim
    weights = [rng.normal(size=(inputs, 8)) / inputs, size * rng.normal(size=(8, outputs))]
    return Mlp(weights, [np.zeros(8), np.array(task.control_centre)])


@pytest.mark.parametrize("name", ["cartpole", "pvtol"])
def test_features_move_as_duals_say(name):
    """Central differences against exact derivatives, where the features are differentiable."""
    task, rng = find_task(name), np.random.default_rng(4)
    see, rows = view_of(task), observed(task, rng).astype(np.float64)
    way = np.zeros_like(rows)
    way[:, task.layout.state] = rng.normal(size=(len(rows), task.system.state_dim))
    found = moved(see, rows, way)
    assert found.shape == (len(rows), len(see.names))
    for row, direction, one in zip(rows, way, found, strict=True):
        given = [Dual(*pair) for pair in zip(row.tolist(), direction.tolist(), strict=True)]
        # Discs and episode stand still: plain numbers, whose comparisons are plain, too.
        still = range(task.layout.size)[task.layout.state]
        for index in set(range(len(row))) - set(still):
            given[index] = float(row[index])
        features = see(given, functions).features
        exact = [each.gradient if isinstance(each, Dual) else 0.0 for each in features]
        np.testing.assert_allclose(one, exact, rtol=1e-5, atol=1e-5)


def observed(task, rng, count=30):
    rows = np.zeros((count, task.layout.size), np.float32)
    for row, episode in zip(rows, episodes_of(task, count), strict=True):
        row[task.layout.state] = episode.initial_state + rng.normal(size=task.system.state_dim)
        row[task.layout.goal] = episode.goal
        row[task.layout.initial_state] = episode.initial_state
        row[task.layout.time] = rng.uniform(0.0, task.time_limit)
        row[task.layout.discs][: episode.discs.size] = episode.discs.ravel()
    return rows


@dataclass(frozen=True)
class Keeping(Slide):
    learning = Learning(keeps_plan=True)


@pytest.mark.parametrize(
    "task", [PvtolSettings(), Slide(), Drive(), Keeping()], ids=lambda task: type(task).__name__
)
def test_features_are_what_their_names_say(task):
    view, rows = view_of(task), observed(task, np.random.default_rng(1))
    features, signs = seen(view, rows)
    assert signs is None
    assert features.shape == (len(rows), len(view.names))
    named = {name: features[:, place] for place, name in enumerate(view.names)}
    state, goal = rows[:, task.layout.state], rows[:, task.layout.goal]
    place, way = state[:, :2], goal[:, :2] - state[:, :2]
    np.testing.assert_allclose(features[:, :2], way, atol=1e-5)
    np.testing.assert_allclose(named["time left [s]"], task.time_limit - rows[:, task.layout.time])
    distance = np.linalg.norm(way, axis=1)
    np.testing.assert_allclose(named["distance of the goal [m]"], distance, rtol=1e-4)
    discs = task.layout.discs_of(rows)
    motion = np.stack([named["motion x [m/s]"], named["motion y [m/s]"]], axis=1)
    for disc in range(task.most_discs):
        apart, radius = discs[:, disc, :2] - place, discs[:, disc, 2]
        there = radius > 0.0
        column = {
            name.removesuffix(f" of disc {disc}"): values
            for name, values in named.items()
            if name.endswith(f" of disc {disc}")
        }
        assert all(not np.any(values[~there]) for values in column.values())
        if "ahead of the start" in column:
            begun = rows[:, task.layout.initial_state][:, :2]
            route, from_start = goal[:, :2] - begun, discs[:, disc, :2] - begun
            length = np.linalg.norm(route, axis=1)
            aside = (route[:, 0] * from_start[:, 1] - route[:, 1] * from_start[:, 0]) / length
            np.testing.assert_allclose(column["aside of the start"][there], aside[there], atol=1e-4)
        gap = np.linalg.norm(apart, axis=1) - radius - task.body_radius
        np.testing.assert_allclose(column["gap [m]"][there], gap[there], atol=1e-5)
        ahead = np.sum(apart * way, axis=1) / distance
        np.testing.assert_allclose(column["place ahead [m]"][there], ahead[there], atol=1e-4)
        # Across the motion, to its left.
        across = motion[:, 0] * apart[:, 1] - motion[:, 1] * apart[:, 0]
        across /= np.maximum(np.linalg.norm(motion, axis=1), 1e-3)
        clear = there & (np.linalg.norm(motion, axis=1) > 0.1)
        np.testing.assert_allclose(
            column["place across it [m]"][clear], across[clear], atol=1e-3, rtol=1e-3
        )


def test_motion_is_that_of_the_position_under_the_resting_control():
    task = PvtolSettings()
    rows = observed(task, np.random.default_rng(4), 5)
    features, _ = seen(view_of(task), rows)
    names = view_of(task).names
    _, _, roll, along, up, _ = rows[:, task.layout.state].T
    motion = (along + 1j * up) * np.exp(1j * roll)
    np.testing.assert_allclose(features[:, names.index("motion x [m/s]")], motion.real, atol=1e-5)
    np.testing.assert_allclose(features[:, names.index("motion y [m/s]")], motion.imag, atol=1e-5)


def test_a_task_may_say_itself_what_is_seen():
    @dataclass(frozen=True)
    class Own(Slide):
        def features(self, observation, functions):
            return functions.sin(observation[0]), observation[4] - observation[0]

    view = view_of(Own())
    assert (len(view.names), view.alike) == (2, None)
    row = np.arange(Own().layout.size, dtype=np.float32)
    np.testing.assert_allclose(seen(view, row)[0], [0.0, 4.0])
    assert view(row.tolist(), functions).signs == ()
    assert view.affine == 0  # there is a sine


def test_features_of_a_user_are_found_to_be_affine_or_not():
    layout = Slide().layout
    time = layout.time

    @dataclass(frozen=True)
    class Straight(Slide):
        def features(self, observation, functions):
            sign = functions.where(observation[layout.goal.start] < 0.0, -1.0, 1.0)
            return sign * observation[0], 2.0 * observation[1] - observation[0], observation[time]

    @dataclass(frozen=True)
    class Mixed(Slide):
        def features(self, observation, functions):
            return observation[0], observation[0] * observation[1], observation[time]

    @dataclass(frozen=True)
    class Late(Slide):
        def features(self, observation, functions):
            return observation[0], observation[time], observation[1]

    assert [view_of(one()).affine for one in (Straight, Mixed, Late)] == [2, 0, 3]


@pytest.mark.parametrize("task", [PvtolSettings(), Slide()], ids=lambda task: task.name)
def test_flights_are_those_of_the_environment(task, tmp_path):
    network = a_network(task)
    episodes = episodes_of(task, 4)
    still = np.zeros((4, task.steps, task.system.state_dim))
    states = flown(task, network, episodes, still)
    file = tmp_path / "network.safetensors"
    network.save(file)
    policy = NetworkPolicy(task, file)
    assert policy.example_features().shape == (len(view_of(task).names),)
    env = gym.make("lagros/Pvtol-v0") if task.name == "pvtol" else gym.make(registered(task))
    for episode, path in zip(episodes, states, strict=True):
        options = {"initial_state": episode.initial_state, "goal": episode.goal}
        observation, _ = env.reset(seed=0, options={**options, "discs": episode.discs})
        for step in range(task.steps):
            action, _ = policy.predict(observation)
            observation, _, over, _, _ = env.step(action)
            if over:
                break
            np.testing.assert_allclose(observation[task.layout.state], path[step + 1], atol=2e-3)


def registered(task):
    if task.env_id not in gym.registry:
        register_task(task)
    return task.env_id


def test_what_goes_wrong_is_planned_anew_from_before_it():
    task = Slide()
    # Straight on, through every disc: a network that pushes ahead.
    inputs = len(view_of(task).names)
    ahead = Mlp([np.zeros((inputs, 2))], [np.array([0.6, 0.0])])
    episodes = episodes_of(task, 40)
    still = np.zeros((40, task.steps, 4))
    states = flown(task, ahead, episodes, still)
    met = met_states(np.random.default_rng(0), task, ahead, episodes, still)
    picked = {which: (step, state) for which, step, state in met}
    for which, episode in enumerate(episodes):
        fine = np.linspace(states[which, :-1, :2], states[which, 1:, :2], 20, axis=1)
        gaps = np.linalg.norm(fine[..., None, :] - episode.discs[:, :2], axis=-1)
        hit = (gaps - episode.discs[:, 2] < task.body_radius).any(axis=(1, 2))
        if hit.any():
            step, state = picked[which]
            assert step == 0 or 1 <= np.argmax(hit) - step <= round(0.25 * task.steps)
            assert np.array_equal(state, states[which, step])
    bad = sum(which in picked for which in range(40))
    assert 20 <= bad < 40


def test_a_round_gives_data_around_plans_that_begin_under_way(tmp_path):
    task = Slide()
    metric = MetricSettings(pool=400, checks=100).design(task)
    assert metric.verification.violations == 0
    inputs = len(view_of(task).names)
    ahead = Mlp([np.zeros((inputs, 2))], [np.array([0.6, 0.0])])
    settings = ExpertDataSettings(plans=8, samples=120, shards=2, disturbance_bound=0.2)
    data = generate(tmp_path / "round", metric, settings, task, network=ahead)
    assert data.observation.shape == (120, task.layout.size)
    assert np.any(data.plan_steps > 0)
    steps = np.rint(data.observation[:, task.layout.time] / task.control_period).astype(int)
    assert np.all(steps >= data.plan_steps[data.plan])
    np.testing.assert_array_equal(
        task.layout.discs_of(data.observation), data.plan_discs[data.plan]
    )
    nominal = data.plan_states[data.plan, steps]
    away = np.linalg.norm(data.observation[:, task.layout.state] - nominal, axis=1)
    first = steps == data.plan_steps[data.plan]
    assert np.all(away[first] == 0.0)
    assert np.all(away < 0.5)
    seen_at, control, plan = data.nominal_pairs(task)
    begun = np.rint(seen_at[:, task.layout.time] / task.control_period).astype(int)
    assert np.all(begun >= data.plan_steps[plan])
    np.testing.assert_array_equal(control, data.plan_controls[plan, begun])
    # Another network is another round.
    with pytest.raises(ValueError, match="round holds expert data of other settings"):
        generate(tmp_path / "round", metric, settings, task, network=a_network(task))


@pytest.mark.parametrize("name", named(SINGLE_BODY))
def test_recorded_a_view_sees_the_same_to_the_last_bit(name, monkeypatch):
    task = task_of(name)
    view, rows = view_of(task), example_observations(task, 50)
    wanted = [seen(view, row) for row in rows]
    quick = pickle.loads(pickle.dumps(RecordedView(view, task.layout.size)))
    # It is not asked again.
    monkeypatch.setattr(type(view), "__call__", None)
    for row, given in zip(rows, wanted, strict=True):
        for found, one in zip(seen(quick, row), given, strict=True):
            assert (found is None) == (one is None)
            assert found is None or found.tobytes() == one.tobytes()


def test_a_view_that_branches_is_asked_itself():
    class Branching:
        names = ("size",)

        def __call__(self, observation, functions):
            return Seen([observation[0] if observation[0] > 0.0 else -observation[0]])

    quick = RecordedView(Branching(), 1)
    assert [seen(quick, np.array([x], np.float32))[0][0] for x in (-2.0, 3.0)] == [2.0, 3.0]


def test_a_network_that_is_to_keep_plans_sees_which_plan_it_is_on():
    """What it sees of an episode tells its plan apart, wherever the body is."""
    task = Keeping()
    view, episodes = view_of(task), observed(task, np.random.default_rng(2), 20)
    rows = np.repeat(episodes[:1], 20, axis=0)
    rows[:, task.layout.initial_state] = episodes[:, task.layout.initial_state]
    assert len(np.unique(seen(view, rows)[0], axis=0)) == 20
    assert len(np.unique(seen(view_of(Slide()), rows)[0], axis=0)) == 1
    names = dict(zip(view.names, seen(view, rows)[0].T, strict=True))
    begun = rows[:, task.layout.initial_state]
    np.testing.assert_allclose(
        names["x1 of the start from here"], begun[:, 1] - rows[:, 1], atol=1e-6
    )
    assert view.names[-1].startswith("presence")
    assert len(view.names) == len(view_of(Slide()).names) + 6 + 3 * task.most_discs


def test_a_round_along_plans_labels_where_the_network_comes_to_around_the_first_plans(tmp_path):
    task = Slide()
    metric = MetricSettings(pool=400, checks=100).design(task)
    settings = ExpertDataSettings(plans=8, samples=200, shards=2, disturbance_bound=1e-9)
    base = generate(tmp_path / "data", metric, settings, task)
    network = a_network(task, size=1.0)
    data = generate(tmp_path / "round", metric, settings, task, network=network, along=base)
    for name, plans in base.plans.items():
        np.testing.assert_array_equal(data.plans[name], plans)
    # As good as undisturbed: every state is one of the flights of the network.
    episodes = [
        Scenario(start, plan[-1], discs[discs[:, 2] > 0.0])
        for start, plan, discs in zip(
            base.plan_starts, base.plan_states, base.plan_discs, strict=True
        )
    ]
    still = np.zeros((len(episodes), task.steps, 4))
    paths = flown(task, network, episodes, still)
    steps = np.rint(data.observation[:, task.layout.time] / task.control_period).astype(int)
    states = data.observation[:, task.layout.state]
    np.testing.assert_allclose(states, paths[data.plan, steps], atol=1e-6)
    # Among them states far from the plan, but none outside the region.
    error = states - base.plan_states[data.plan, steps]
    assert 0.2 < np.abs(error).max() <= max(task.metric.error)
    law = base.plan_controls[data.plan, steps] + np.einsum("smi,si->sm", data.gain, error)
    np.testing.assert_allclose(data.control, np.clip(law, -4.0, 4.0), atol=1e-9)


def test_a_task_without_a_metric_is_told_so():
    @dataclass(frozen=True)
    class Bare(Slide):
        metric = None

    with pytest.raises(ValueError, match="slide describes no contraction metric"):
        metric_settings(Bare()).design(Bare())

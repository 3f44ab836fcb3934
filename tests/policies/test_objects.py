"""Policies as Python objects: copied, pickled, shared by threads, and fed what is none of the task.

Walks every policy of both tasks, with the safety filter and the remarks of the paper.
"""

import copy
import json
import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from functools import cache
from typing import Any

import numpy as np
import pytest

from lagros_envs import spacecraft_v0
from lagros_envs.tasks.cartpole.env import CartPoleEnv
from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_policies import NAMES, make
from lagros_policies.tasks.spacecraft import SPACECRAFT_NAMES
from lagros_policies.tasks.spacecraft.safety_filter import SafetyFilter

OPTIONS = "lagros_policies.tasks.cartpole.remarks:"
SLIDING = "lagros_policies.tasks.spacecraft.sliding:SlidingCentralizedPolicy"
CARTPOLE = (*NAMES, f"{OPTIONS}AdaptiveTubeMpcPolicy", f"{OPTIONS}NeuralTubeMpcPolicy")
SPACECRAFT = (
    *SPACECRAFT_NAMES,
    SLIDING,
    "lagros+filter",
    "tube-mpc+filter",
    "centralized+filter",
)
EVERY = [("cartpole", name) for name in CARTPOLE] + [("spacecraft", name) for name in SPACECRAFT]
EVERY_DETERMINISTIC = [(task, name) for task, name in EVERY if name != "random"]
each = pytest.mark.parametrize(("task", "name"), EVERY)
each_deterministic = pytest.mark.parametrize(("task", "name"), EVERY_DETERMINISTIC)


def plans_online(name):
    parts = "tube-mpc", "tubempc", "lqr-plan", "sd-lqr", "c3m"
    return name == "mpc" or any(part in name.lower() for part in parts)


def world(task):
    if task == "cartpole":
        return CartPoleEnv(disturbance="uniform")
    return spacecraft_v0.parallel_env(2, "open", disturbance="uniform")


def built(task, name) -> Any:
    """Return a new policy; the deadline of those that plan never passes."""
    name, _, filtered = name.partition("+")
    # The spacecraft's regulator plans before it flies, and has none.
    timed = plans_online(name) and (task, name) != ("spacecraft", "lqr-plan")
    late = {"deadline": 1e9} if timed else {}
    env = world(task)
    policy = make(name, env, **late)
    return SafetyFilter(policy, env.settings, env.preset) if filtered else policy


@cache
def seen(task, name, seed=0, count=8) -> tuple[np.ndarray, ...]:
    """Return observations of an episode that LQR, or standing still, has flown."""
    env: Any = world(task)
    if task == "cartpole":
        hand = make("lqr", env)
        observation, _ = env.reset(seed=seed)
        rows = [observation]
        for _ in range(count):
            observation, *_ = env.step(hand.predict(observation)[0])
            rows.append(observation)
        return tuple(rows)
    observed = built(task, name).observes
    observations, _ = env.reset(seed=seed)
    rows = []
    for _ in range(count):
        rows.append(env.state() if observed == "global" else np.stack([*observations.values()]))
        still = {agent: np.zeros(8, np.float32) for agent in env.agents}
        observations, *_ = env.step(still)
    return tuple(rows)


def flown(policy, rows, state=None):
    """Return the actions of one episode, one after the other."""
    actions = []
    for row in rows:
        action, state = policy.predict(row, state)
        actions.append(action)
    return np.array(actions)


def duplicates(policy, state):
    """Yield the policy and its memory as copies, by name."""
    # One copy of both together: nothing may be shared with the original.
    yield copy.deepcopy((policy, state))
    for protocol in range(2, pickle.HIGHEST_PROTOCOL + 1):
        yield pickle.loads(pickle.dumps((policy, state), protocol))
    yield copy.copy(policy), copy.copy(state)


@each
def test_a_copy_at_any_moment_goes_on_alike(task, name):
    rows = seen(task, name)
    policy = built(task, name)
    state = None
    for step, row in enumerate(rows):
        if step in (0, 1, 4):
            copies = list(duplicates(policy, state))
            if name == "random":
                copies.pop()  # a shallow copy draws from the same generator
            rest = [flown(twin, rows[step:], memory) for twin, memory in copies]
            # The copies have flown to the end; the original knows nothing of it.
            own = flown(copy.deepcopy(policy), rows[step:], copy.deepcopy(state))
            for other in rest:
                assert np.array_equal(other, own)
        _, state = policy.predict(row, state)


@each_deterministic
def test_a_memory_is_not_changed_by_what_comes_after(task, name):
    rows = seen(task, name)
    policy = built(task, name)
    _, state = policy.predict(rows[0])
    _, state = policy.predict(rows[1], state)
    kept = pickle.dumps(state)
    first = flown(policy, rows[2:], state)
    assert pickle.dumps(state) == kept
    # Two futures of one past, one after the other.
    assert np.array_equal(flown(policy, rows[2:], state), first)


@each_deterministic
def test_two_episodes_at_a_time_are_as_one_after_the_other(task, name):
    episodes = [seen(task, name, seed, 5) for seed in (0, 1)]
    expected = [flown(built(task, name), rows) for rows in episodes]
    policy = built(task, name)
    states: list[Any] = [None, None]
    actions: list[list[Any]] = [[], []]
    for step in range(5):
        for index, rows in enumerate(episodes):
            action, states[index] = policy.predict(rows[step], states[index])
            actions[index].append(action)
    for found, wanted in zip(actions, expected, strict=True):
        assert np.array_equal(np.array(found), wanted[:5])


@each_deterministic
def test_threads_share_a_policy(task, name):
    planner = plans_online(name) or "entralized" in name
    count = 4 if planner else 200
    episodes = [seen(task, name, seed, 4) for seed in (0, 1, 2)]
    expected = [flown(built(task, name), rows) for rows in episodes]
    policy = built(task, name)

    def work(index):
        turns = [flown(policy, episodes[index]) for _ in range(count // 4)]
        return all(np.array_equal(turn, expected[index]) for turn in turns)

    with ThreadPoolExecutor(3) as pool:
        assert all(pool.map(work, [0, 1, 2] * 2))


@each
def test_what_is_no_observation_is_refused(task, name):
    policy = built(task, name)
    row = seen(task, name)[0]
    spoiled = []
    for value in (np.nan, np.inf, -np.inf):
        for index in (0, row.shape[-1] - 1):
            bad = row.copy()
            bad[..., index] = value
            spoiled.append(bad)
    shapes = [row[..., :-1], np.concatenate([row, row], axis=-1), row[None, None], row[..., 0]]
    others = ["text", None, {"agent_0": row}, [[1.0], [1.0, 2.0]], np.float32(1.0), object()]
    others += [row.astype(kind) for kind in (str, bool, object, complex)]
    others += [np.ma.masked_array(row, mask=True), row.astype(bool).tolist()]
    for bad in (*spoiled, *shapes, *others):
        with pytest.raises(ValueError, match="observation") as caught:
            policy.predict(bad)
        assert "\n" not in str(caught.value)
    # And nothing is left behind.
    action, _ = policy.predict(row)
    assert np.isfinite(action).all()


@each
def test_a_batch_of_no_rows_has_no_actions_or_is_refused(task, name):
    row = seen(task, name)[0]
    policy = built(task, name)
    none = (row if row.ndim == 2 else row[None])[:0]
    if task == "spacecraft":
        with pytest.raises(ValueError, match="the observation has no rows"):
            policy.predict(none)
        return
    action, _ = policy.predict(none)
    assert (action.shape, action.dtype) == ((0, 1), np.float32)


@each
def test_the_action_belongs_to_the_caller(task, name):
    policy = built(task, name)
    rows = seen(task, name)
    before = rows[0].copy()
    action, state = policy.predict(rows[0])
    kept = action.copy()
    again, _ = policy.predict(rows[1], state)
    assert np.array_equal(action, kept)
    again[...] = 7.0
    if name != "random":
        assert np.array_equal(policy.predict(rows[0])[0], kept)
    assert np.array_equal(rows[0], before)


@pytest.mark.parametrize("observation", ["read-only", "list", "float64", "strided"])
@each_deterministic
def test_takes_an_observation_in_any_form(task, name, observation):
    row = seen(task, name)[0]
    expected, _ = built(task, name).predict(row)
    form: Any = row.copy()
    if observation == "read-only":
        form.flags.writeable = False
    elif observation == "list":
        form = row.tolist()
    elif observation == "float64":
        form = row.astype(np.float64)
    else:
        form = np.repeat(row, 2, axis=-1)[..., ::2]
    action, _ = built(task, name).predict(form)
    assert action.dtype == np.float32
    assert np.allclose(action, expected, atol=1e-6)


@pytest.mark.parametrize("kind", [CartPoleSettings, SpacecraftSettings])
def test_settings_are_written_as_json_and_copied(kind):
    settings = kind()
    text = json.dumps(asdict(settings))
    assert json.loads(text)["control_period"] == 0.1
    for twin in (copy.deepcopy(settings), pickle.loads(pickle.dumps(settings))):
        assert twin == settings
        assert hash(twin) == hash(settings)
    if kind is CartPoleSettings:
        assert CartPole(**json.loads(text)["system"]) == settings.system


PLANNERS = [
    (task, name)
    for task, name in EVERY
    if plans_online(name) or "entralized" in name or "filter" in name
]


@pytest.mark.parametrize(("task", "name"), PLANNERS)
def test_a_memory_of_another_kind_is_refused(task, name):
    policy = built(task, name)
    row = seen(task, name)[0]
    for state in ("text", 3, [1], [object()] * 2, {"a": 1}, np.zeros(2), [None] * 7):
        with pytest.raises(ValueError, match=r"state|memories"):
            policy.predict(row, state)


@pytest.mark.parametrize(("task", "name"), [pair for pair in PLANNERS if "lagros+" not in pair[1]])
def test_a_memory_of_the_last_episode_is_refused_or_given_up(task, name):
    policy = built(task, name)
    _, state = policy.predict(seen(task, name, 0)[0])
    for row in seen(task, name, 0)[1:]:
        _, state = policy.predict(row, state)
    row = seen(task, name, 1)[0]
    with pytest.raises(ValueError, match="episode_start"):
        policy.predict(row, state)
    count = len(np.atleast_2d(row))
    action, _ = policy.predict(row, state, np.ones(count, bool))
    assert np.array_equal(action, policy.predict(row)[0])

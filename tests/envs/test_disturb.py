"""`disturb`: bounded, paired, searchable disturbance for environments of somebody else's."""

from __future__ import annotations

import copy
import pickle
import warnings
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test

from lagros_envs import disturb
from lagros_envs.disturbances import OPEN_LOOP
from lagros_envs.foreign import adapters
from tests import documents
from tests.envs.foreign_worlds import STEP, Drift, Joints, OfDrift, OfPair, Pair, particles

KINDS = [kind for kind in OPEN_LOOP if kind != "none"]
PENDULUM = "Pendulum-v1"


def drifting(kind="uniform", bound=0.5, **settings):
    """Return the small environment under disturbance."""
    settings = {"adapter": OfDrift(), "steps": 30, **settings}
    return disturb(Drift(), kind, bound=bound, **settings)


def pendulum(kind="uniform", bound=0.5, **settings):
    """Return Gymnasium's pendulum under disturbance."""
    return disturb(gym.make(PENDULUM), kind, bound=bound, **settings)


ENVS = {"drift": drifting, "pendulum": pendulum}


def where(env):
    """Return the state."""
    own = env.unwrapped
    return np.array(own.where if isinstance(own, Drift) else own.state)


def actions_of(env, seed, count=20):
    """Return some actions."""
    space, rng = env.action_space, np.random.default_rng(seed)
    return rng.uniform(space.low, space.high, (count, *space.shape)).astype(np.float32)


def flown(env, seed=3, actions=None):
    """Return observations, rewards and disturbances of a flight."""
    actions = actions_of(env, 1) if actions is None else actions
    observation, info = env.reset(seed=seed)
    assert not info["disturbance"].any()
    seen, rewards, pushes = [observation], [], []
    for action in actions:
        observation, reward, *_, info = env.step(action)
        seen.append(observation)
        rewards.append(reward)
        pushes.append(info["disturbance"])
    return np.array(seen), np.array(rewards), np.array(pushes)


def same(first, second):
    """Return whether two flights are the same to the bit."""
    return all(np.array_equal(one, other) for one, other in zip(first, second, strict=True))


@pytest.mark.parametrize("name", ENVS)
@pytest.mark.parametrize("kind", KINDS)
def test_the_bound_holds_and_an_episode_has_one_disturbance_whatever_is_done(name, kind):
    first = flown(ENVS[name](kind))[2]
    lengths = np.linalg.norm(first, axis=-1)
    assert 0.0 < lengths.max() <= 0.5 * (1 + 1e-12)
    env = ENVS[name](kind)
    other = flown(env, actions=actions_of(env, 2))[2]
    assert np.array_equal(first, other)
    assert not np.array_equal(first, flown(env, seed=4)[2])


@pytest.mark.parametrize("kind", KINDS)
def test_a_larger_bound_is_the_same_realisation_larger(kind):
    small, large = (flown(drifting(kind, bound))[2] for bound in (0.5, 2.0))
    assert np.allclose(4.0 * small, large, rtol=1e-12, atol=0.0)


@pytest.mark.parametrize("name", ENVS)
def test_without_disturbance_nothing_changes_to_the_last_bit(name):
    bare = {"drift": Drift, "pendulum": partial(gym.make, PENDULUM)}[name]()
    actions = actions_of(bare, 1)
    observation, _ = bare.reset(seed=3)
    seen, rewards = [observation], []
    for action in actions:
        observation, reward, *_ = bare.step(action)
        seen.append(observation)
        rewards.append(reward)
    for kind, bound in (("uniform", 0.0), ("none", 0.5), (np.zeros((5, 2)), 0.0)):
        calm = flown(ENVS[name](kind, bound), actions=actions)
        assert np.array_equal(calm[0], seen)
        assert np.array_equal(calm[1], rewards)


def test_a_step_is_that_of_the_environment_from_the_pushed_state():
    env, alone = pendulum("sphere", 2.0), gym.make(PENDULUM)
    env.reset(seed=5)
    alone.reset(seed=5)
    for action in actions_of(env, 1):
        before = np.array(env.unwrapped.state)
        mine = env.step(action)
        alone.unwrapped.state = before + env.unwrapped.dt * mine[4]["disturbance"]
        theirs = alone.step(action)
        assert np.array_equal(mine[0], theirs[0])
        assert mine[1:4] == theirs[1:4]


def test_to_first_order_it_is_d_in_the_equation_of_motion():
    """Of a linear motion the end differs by the sum of dt d alone."""
    env = drifting("gust")
    seen, _, pushes = flown(env, actions=np.zeros((20, 2), np.float32))
    moved = seen[0] + np.cumsum(STEP * pushes, axis=0)
    assert np.allclose(seen[1:], moved, rtol=0.0, atol=1e-12)


def test_reward_and_end_are_of_the_state_that_the_environment_is_in():
    env = disturb(Drift(edge=0.5), "constant", bound=5.0, adapter=OfDrift(), steps=10)
    env.reset(seed=0)
    calm = np.zeros(2, np.float32)
    for _ in range(10):
        observation, reward, terminated, *_ = env.step(calm)
        size = np.linalg.norm(observation)
        assert reward == -size
        assert terminated == (size > 0.5)
    assert terminated


def test_scale_and_channels():
    scaled = flown(drifting("sphere", 0.5, scale=(1.0, 4.0)))[2]
    plain = flown(drifting("sphere", 0.5))[2]
    assert np.allclose(scaled, plain * (1.0, 4.0), rtol=1e-12, atol=0.0)
    assert np.allclose(np.linalg.norm(scaled / (1.0, 4.0), axis=-1), 0.5, rtol=1e-9)
    one = flown(drifting("sphere", 0.5, channels=(False, True)))[2]
    assert not one[:, 0].any()
    assert np.allclose(np.abs(one[:, 1]), 0.5)


def test_a_function_is_projected_onto_the_ball_and_sees_no_nominal():
    seen = []

    def away(situation):
        seen.append(situation)
        return 100.0 * situation.state

    env = drifting(away)
    observations, _, pushes = flown(env)
    assert np.allclose(np.linalg.norm(pushes, axis=-1), 0.5)
    assert np.array_equal(seen[1].state, observations[1])
    assert seen[0].nominal is None
    assert np.allclose([one.time for one in seen], STEP * np.arange(20))


def test_a_sequence_is_flown_as_it_is():
    pushes = np.random.default_rng(0).uniform(-0.3, 0.3, (20, 2))
    env = drifting(pushes)
    assert np.array_equal(flown(env)[2], pushes)
    # Its last push stays.
    assert np.array_equal(flown(drifting(pushes[:5]))[2][5:], np.repeat(pushes[4:5], 15, 0))


def test_episodes_without_a_seed_go_on_and_the_bound_does_not_shift_them():
    def later(bound):
        env = drifting("uniform", bound)
        env.reset(seed=1)
        drawn = []
        for _ in range(3):
            env.reset()
            drawn.append(env.step(np.zeros(2, np.float32))[4]["disturbance"])
        return np.array(drawn)

    assert np.allclose(later(1.0), 2.0 * later(0.5))
    assert len(np.unique(later(0.5))) == 6


@pytest.mark.parametrize("name", ENVS)
def test_copies_and_pickles_share_nothing(name):
    env = ENVS[name]()
    flown(env)
    for made in (copy.copy(env), copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        before = where(env)
        later = [made.step(action) for action in actions_of(env, 8, 3)]
        assert np.array_equal(before, where(env))
        again_made = copy.deepcopy(env)
        again = [again_made.step(action) for action in actions_of(env, 8, 3)]
        assert all(np.array_equal(a[0], b[0]) for a, b in zip(later, again, strict=True))


def test_the_spec_is_json_and_makes_the_same():
    for kind in ("gust", np.full((4, 2), 0.1)):
        env = pendulum(kind, scale=(1.0, 5.0), channels=(True, True))
        made = gym.make(EnvSpec.from_json(env.spec.to_json()))
        assert same(flown(env), flown(made))


def test_vectors_hold_wrapped_environments():
    wrapped = partial(disturb, kind="uniform", bound=0.5)
    for vector in (
        gym.make_vec(PENDULUM, 2, wrappers=[wrapped]),
        gym.make_vec(pendulum().spec, 2),
        gym.vector.AsyncVectorEnv([partial(wrapped_pendulum), partial(wrapped_pendulum)]),
    ):
        vector.reset(seed=[3, 4])
        actions = np.zeros((2, 1), np.float32)
        pushes = vector.step(actions)[4]["disturbance"]
        vector.close()
        for seed, push in zip((3, 4), pushes, strict=True):
            env = pendulum()
            env.reset(seed=seed)
            assert np.array_equal(env.step(actions[0])[4]["disturbance"], push)


def wrapped_pendulum():
    """Return the pendulum, for a process of its own."""
    return pendulum()


@pytest.mark.parametrize("name", ["Pendulum-v1", "Acrobot-v1", "MountainCarContinuous-v0"])
def test_gymnasium_finds_nothing_wrong(name):
    bare = gym.make(name, disable_env_checker=True)
    env = disturb(bare, bound=0.2, period=None if hasattr(bare.unwrapped, "dt") else 1.0)
    with warnings.catch_warnings():
        # It has to be a wrapper, and Gymnasium's own spaces are as they are.
        warnings.filterwarnings("ignore", message=".*(different from the unwrapped|Box|render).*")
        check_env(env, skip_render_check=True)


def test_a_pair_of_agents_has_a_disturbance_each():
    env = disturb(Pair(), "uniform", bound=0.5, adapter=OfPair())
    parallel_api_test(env, num_cycles=20)
    drawn = []
    for size in (0.0, 1.0):
        start, infos = env.reset(seed=2)
        assert not infos["left"]["disturbance"].any()
        move = dict.fromkeys(env.agents, np.full(2, size, np.float32))
        seen, *_, infos = env.step(move)
        pushes = {agent: infos[agent]["disturbance"] for agent in env.agents}
        for agent, push in pushes.items():
            assert 0.0 < np.linalg.norm(push) <= 0.5
            assert np.allclose(seen[agent], start[agent] + STEP * (push + size))
        drawn.append(np.array(list(pushes.values())))
    assert np.array_equal(*drawn)
    assert not np.array_equal(drawn[0][0], drawn[0][1])
    made = pickle.loads(pickle.dumps(env))
    copied = copy.copy(env)
    for other in (made, copied):
        step = {agent: np.zeros(2, np.float32) for agent in env.agents}
        before = env.unwrapped.rows.copy()
        one = other.step(step)[0]
        assert np.array_equal(env.unwrapped.rows, before)
        assert np.array_equal(copy.deepcopy(env).step(step)[0]["left"], one["left"])


def test_the_adapter_of_mujoco():
    adapter, env = adapters.Mujoco(), Joints([1.0, 2.0], [3.0, 4.0])
    assert adapters.Mujoco.fits(env)
    assert adapter.state(env).tolist() == [1.0, 2.0, 3.0, 4.0]
    adapter.set_state(env, np.arange(4.0))
    assert adapter.state(env).tolist() == [0.0, 1.0, 2.0, 3.0]
    assert adapter.rates(env) == [False, False, True, True]
    assert adapter.period(env) == 0.05
    turning = Joints([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    adapter.set_state(turning, np.array([1.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0]))
    assert turning.data.qvel.tolist() == [1.0, 2.0, 3.0]
    with pytest.raises(ValueError, match=r'quaternions.*channels="rates"'):
        adapter.set_state(turning, np.full(7, 0.5))


def test_the_adapter_of_particle_worlds():
    torch = pytest.importorskip("torch")
    mpe = particles(np.array, p_pos=[1.0, 2.0], p_vel=[3.0, 4.0])
    rows = [[1.0, 2.0], [0.5], [3.0, 4.0], [6.0]]
    names = ("pos", "rot", "vel", "ang_vel")
    vmas = particles(lambda row: torch.tensor([row]), **dict(zip(names, rows, strict=True)))
    for world, count, rates in ((mpe, 4, 2), (vmas, 6, 3)):
        adapter = adapters.adapter_for(world)
        state = adapter.state(world)
        assert state.shape == (2, count)
        assert adapter.rates(world) == [False] * (count - rates) + [True] * rates
        fresh = np.arange(2.0 * count).reshape(2, count)
        adapter.set_state(world, fresh)
        assert np.array_equal(adapter.state(world), fresh)
    several = particles(lambda row: torch.tensor([row, row]), pos=[1.0], rot=[], vel=[], ang_vel=[])
    with pytest.raises(ValueError, match="num_envs=1"):
        adapters.adapter_for(several).state(several)


def test_environments_of_mujoco_where_it_is_installed():
    pytest.importorskip("mujoco")
    for kind, bound in (("uniform", 0.5), ("uniform", 0.0)):
        env = disturb(gym.make("Hopper-v5"), kind, bound=bound, channels="rates")
        bare = gym.make("Hopper-v5")
        actions = actions_of(env, 1)
        seen, _, pushes = flown(env, actions=actions)
        alone = [bare.reset(seed=3)[0], *(bare.step(action)[0] for action in actions)]
        assert np.array_equal(seen, alone) == (bound == 0.0)
        assert not pushes[:, :6].any()
        assert np.linalg.norm(pushes, axis=-1).max() <= bound
    with pytest.raises(ValueError, match="quaternions"):
        flown(disturb(gym.make("Ant-v5"), bound=0.5))
    flown(disturb(gym.make("Ant-v5"), bound=0.5, channels="rates"))


def test_worlds_of_mpe_where_they_are_installed():
    worlds = pytest.importorskip("mpe2.simple_spread_v3")
    env = disturb(worlds.parallel_env(N=3, continuous_actions=True), "constant", bound=0.3)
    parallel_api_test(env, num_cycles=10)
    env.reset(seed=0)
    pushes = env.step({agent: np.zeros(5, np.float32) for agent in env.agents})[4]
    lengths = [np.linalg.norm(info["disturbance"]) for info in pushes.values()]
    assert lengths == pytest.approx([0.3] * 3)


def test_worlds_of_vmas_where_they_are_installed():
    vmas = pytest.importorskip("vmas")
    world = vmas.make_env(
        "navigation", 1, device="cpu", wrapper="gymnasium", n_agents=2, terminated_truncated=True
    )
    env = disturb(world, "constant", bound=0.3, channels="rates", steps=20)
    env.reset(seed=0)
    push = env.step(env.action_space.sample())[4]["disturbance"]
    assert not push[:, :3].any()
    assert np.linalg.norm(push, axis=-1) == pytest.approx([0.3] * 2)


def test_what_the_page_shows_runs(capsys):
    page = Path(__file__).parents[2] / "docs" / "disturb.md"
    wrapped, adapter, described = documents.python_blocks(page.read_text(encoding="utf-8"))
    exec(wrapped, {})
    assert np.fromstring(capsys.readouterr().out.strip("[]\n"), sep=" ").shape == (2,)
    names = {}
    exec(adapter, names)
    exec(described, names)
    env = Drift()
    env.body = SimpleNamespace(position=[0.0, 1.0], velocity=[2.0, 3.0])
    own = names["OfMine"]()
    own.set_state(env, np.arange(4.0) + 1.0)
    assert own.state(env) == [1.0, 2.0, 3.0, 4.0]
    assert names["task"].facts.states == 2
    pushed = flown(names["task"].make("sphere", 0.5))[2]
    assert not pushed[:, 0].any()
    assert np.allclose(np.abs(pushed[:, 1]), 2.5)


class Deaf(OfDrift):
    """Sets nothing."""

    def set_state(self, env, state):
        """Do nothing."""


class Swapped(OfDrift):
    """Sets the coordinates the wrong way round."""

    def set_state(self, env, state):
        """Set them."""
        env.where = state[::-1]


class Mute(OfDrift):
    """Reads what is no number."""

    def state(self, env):
        """Return it."""
        return [np.nan, 0.0]


class Timeless:
    """Knows of no control step."""

    state, set_state = OfDrift.state, OfDrift.set_state


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"adapter": Deaf()}, "Deaf: after set_state.*must be what was set"),
        ({"adapter": Swapped()}, "Swapped: after set_state.*must be what was set"),
        ({"adapter": Mute()}, "Mute: state\\(env\\) returned"),
        ({"adapter": Timeless()}, "does not say how long a control step is"),
        ({"adapter": Timeless(), "period": -1.0}, "period=-1.0"),
        ({"adapter": object()}, "no state and no set_state"),
        ({"adapter": OfDrift}, "the class OfDrift"),
        ({"adapter": "no.such:Class"}, "write module:Class"),
        ({"adapter": None}, "no adapter knows how to read and set the state of Drift"),
        ({"steps": None}, "no limit of steps"),
        ({"steps": 0}, "steps=0"),
        ({"scale": (1.0, 0.0)}, "scale=.*positive"),
        ({"scale": (1.0, 1.0, 1.0)}, "scale has 3 entries; the state has 2"),
        ({"channels": "rates"}, "does not say which of the 2 coordinates are rates"),
        ({"channels": (True,)}, "^channels has 1 entries"),
        ({"channels": (False, False)}, "channels must leave"),
        ({"kind": "worst"}, "`lagros attack` searches"),
        ({"kind": "wind"}, "'wind' is not known"),
        ({"bound": -1.0}, "disturbance_bound=-1.0"),
        ({"kind": np.ones((5, 2))}, "above bound=0.5"),
        ({"kind": np.full((5, 3), 0.1)}, "shape \\(3,\\); the state has shape \\(2,\\)"),
        ({"kind": np.full((5, 2), 0.1), "channels": (True, False)}, "not among the channels"),
        ({"kind": [["a"]]}, "must be the name of a kind"),
    ],
)
def test_what_is_wrong_is_said(settings, message):
    def fly():
        env = drifting(**settings)
        env.reset(seed=0)
        env.step(np.zeros(2, np.float32))

    with pytest.raises((ValueError, TypeError), match=message):
        fly()


def test_what_is_no_environment_or_has_a_disturbance_is_refused():
    with pytest.raises(ValueError, match="has a disturbance of its own"):
        disturb(gym.make("lagros/Pvtol-v0"), bound=0.1)
    vector = gym.make_vec(PENDULUM, 2)
    for what in (vector, "Pendulum-v1", None):
        with pytest.raises(TypeError, match="must be an environment"):
            disturb(what, bound=0.1)


def test_a_step_before_reset_is_refused_by_the_environment():
    with pytest.raises(gym.error.ResetNeeded):
        pendulum().step(np.zeros(1, np.float32))

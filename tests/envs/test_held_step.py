"""Recorded, in buffers or compiled: a held step is `rk4_hold` of the same physics."""

import importlib.util
import math
import pickle
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

import lagros_envs  # noqa: F401 - registers the ids
from lagros_envs.dynamics import compiled, hold_step
from lagros_envs.dynamics.held import HeldBatch, HeldStep, has_numba
from lagros_envs.dynamics.integrate import rk4_hold
from lagros_envs.dynamics.straight_line import ArrayFunction, straight_line
from lagros_envs.rules import StepRules
from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_envs.tasks.spacecraft.physics import Spacecraft

ODD = CartPole(cart_mass=2.3, pole_mass=0.4, half_length=0.7, cart_friction=0.0)
SYSTEMS = [
    pytest.param(CartPole(), id="cart-pole"),
    pytest.param(ODD, id="another cart"),
    pytest.param(Spacecraft(mass=1.7, inertia=0.6).by_wrench, id="spacecraft"),
]
needs_numba = pytest.mark.skipif(
    importlib.util.find_spec("numba") is None, reason="numba is not installed"
)
BACKENDS = [False, pytest.param(True, marks=needs_numba)]


def numbers(system, count, seed=0):
    rng = np.random.default_rng(seed)
    state = rng.uniform(-2.0, 2.0, (count, system.state_dim))
    control = rng.uniform(-30.0, 30.0, (count, system.control_dim))
    push = rng.uniform(-1.0, 1.0, (count, system.state_dim))
    return state, control, push


@pytest.mark.parametrize("compiled", BACKENDS)
@pytest.mark.parametrize("system", SYSTEMS)
def test_a_step_on_floats_is_the_integrator_bit_for_bit(system, compiled):
    run = HeldStep(system, 0.1, compiled).run
    for state, control, push in zip(*numbers(system, 40), strict=True):
        expected = rk4_hold(system, state.tolist(), control.tolist(), push.tolist(), 0.1, math)
        found, measured = run(*(tuple(part.tolist()) for part in (state, control, push)))
        assert (found, measured) == (tuple(expected), ())


@pytest.mark.parametrize("substeps", [1, 3, 4])
@pytest.mark.parametrize("system", SYSTEMS)
def test_a_batch_is_the_integrator_bit_for_bit(system, substeps):
    state, control, push = numbers(system, 21)
    hold = HeldBatch(system, 0.1, (7, 3), substeps=substeps)
    shaped = [part.T.reshape(-1, 7, 3) for part in (state, control, push)]
    expected = hold_step(system, state, control, 0.1, push, substeps)
    # Twice: buffers that are used again must not remember the first time.
    for _ in range(2):
        np.testing.assert_array_equal(hold(*shaped).reshape(-1, 21).T, expected)
    again = hold_step(system, expected, control, 0.1, push, substeps)
    np.testing.assert_array_equal(hold.go_on(hold(*shaped)).reshape(-1, 21).T, again)


@needs_numba
@pytest.mark.parametrize("system", SYSTEMS)
def test_a_compiled_batch_differs_in_the_last_digits_only(system):
    state, control, push = numbers(system, 50)
    hold = HeldBatch(system, 0.1, (50,), compiled=True)
    expected = hold_step(system, state, control, 0.1, push)
    np.testing.assert_allclose(hold(state.T, control.T, push.T).T, expected, rtol=1e-12, atol=1e-12)
    again = hold_step(system, expected, control, 0.1, push)
    found = hold.go_on(hold(state.T, control.T, push.T))
    np.testing.assert_allclose(found.T, again, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("reach", [1.6, 30.0, 1e5])
def test_the_vectorisable_sine_and_cosine_are_exact_to_rounding(reach):
    angles = np.concatenate([np.linspace(-reach, reach, 20001), [0.0, math.pi, -math.pi / 2]])
    for ours, exact in (
        (compiled.VectorFunctions.sin, np.sin),
        (compiled.VectorFunctions.cos, np.cos),
    ):
        np.testing.assert_allclose(ours(angles), exact(angles), rtol=0.0, atol=6e-16)


@pytest.mark.parametrize("powers", [range(3, 18, 2), range(2, 17, 2)])
def test_economised_series_err_less_than_rounding(powers):
    """Against the series in fractions, far longer than need be, up to pi/2."""
    coefficients = [Fraction(one) for one in compiled._economised(powers)]
    for angle in np.linspace(0.0, math.pi / 2, 41):
        exact = [
            Fraction((-1) ** (power // 2), math.factorial(power)) * Fraction(angle) ** power
            for power in range(powers.start, 40, 2)
        ]
        found = [
            one * Fraction(angle) ** power for one, power in zip(coefficients, powers, strict=True)
        ]
        # The coefficients are doubles: their own rounding is a hundredth of that of the result.
        assert abs(sum(found) - sum(exact)) < Fraction(1, 10**16)


def moments(count, seed=1):
    """What the rules of a step are given, in every case that they tell apart."""
    rng = np.random.default_rng(seed)
    goals = rng.uniform(-2.0, 2.0, (4, count))
    time = np.full(count, 0.7)
    success_time = rng.choice([0.3, math.inf], count)
    effort = rng.uniform(1.0, 2.0, (2, count))
    return np.stack([*goals, time, rng.uniform(0.0, 8.0, count), *effort, success_time])


@pytest.mark.parametrize("compiled", BACKENDS)
def test_rules_on_floats_are_their_function_bit_for_bit(compiled):
    rules = StepRules(CartPoleSettings(system=ODD))
    run = HeldStep(ODD, 0.1, compiled, measure=rules, given=rules.given).run
    for state, control, push, given in zip(*numbers(ODD, 40), moments(40).T, strict=True):
        end = rk4_hold(ODD, state.tolist(), control.tolist(), push.tolist(), 0.1, math)
        expected = tuple(end), tuple(rules(end, control.tolist(), given.tolist(), math))
        found = run(*(tuple(part.tolist()) for part in (state, control, push, given)))
        assert found == expected
        assert [type(value) for value in found[1][-2:]] == [bool, bool]


@needs_numba
@pytest.mark.parametrize("worlds", [1, 127, 128, 300])
def test_blocks_that_are_not_full_change_nothing(worlds):
    state, control, push = (part.T for part in numbers(ODD, 300))
    whole = HeldBatch(ODD, 0.1, (300,), compiled=True)(state, control, push).copy()
    part = HeldBatch(ODD, 0.1, (worlds,), compiled=True)
    for _ in range(2):
        found = part(state[:, :worlds], control[:, :worlds], push[:, :worlds])
        np.testing.assert_array_equal(found, whole[:, :worlds])


@pytest.mark.parametrize("compiled", BACKENDS)
def test_the_rules_judge_the_state_at_the_end(compiled):
    """Against the rules written out, world by world."""
    settings = CartPoleSettings(system=ODD, effort_weight=0.3, distance_weight=2.0)
    rules = StepRules(settings)
    state, force, push = numbers(ODD, 300)
    given = moments(300)
    hold = HeldBatch(ODD, 0.1, (300,), compiled, measure=rules, given=rules.given)
    end = hold(state.T, force.T, push.T, given).T
    seen = set()
    for world, x in enumerate(end):
        goal, (time, radius, effort, frozen, success_time) = given[:4, world], given[4:, world]
        distance, spent = np.linalg.norm(x - goal), 0.1 * force[world, 0] ** 2
        fallen = abs(x[1]) > math.pi / 2
        inside = distance <= radius and not fallen
        first = inside and math.isinf(success_time)
        seen.add((fallen, inside, math.isinf(success_time)))
        reward = settings.reward(spent, distance, bool(first), bool(fallen))
        expected = [
            effort + spent,
            effort + spent if math.isinf(success_time) else frozen,
            time if first else success_time,
            distance,
            reward,
            fallen,
            inside,
        ]
        np.testing.assert_allclose(hold.measured[:, world], expected, rtol=1e-12, atol=1e-11)
    assert len(seen) == 6


@pytest.mark.parametrize("first", [False, True])
@pytest.mark.parametrize("fallen", [False, True])
def test_a_reward_is_what_its_page_says(first, fallen):
    settings = CartPoleSettings(upright_bonus=7.0, success_bonus=5.0)
    expected = -0.01 * 3.0 + 0.1 * (7.0 - 2.0) * (not fallen) + 5.0 * first
    assert settings.reward(3.0, 2.0, first, fallen) == pytest.approx(expected)
    arrays = settings.reward(3.0, np.array([2.0]), np.array([first]), np.array([fallen]))
    assert arrays == pytest.approx(expected)


@pytest.mark.parametrize("compiled", BACKENDS)
def test_steps_survive_a_pickle(compiled):
    state, control, push = numbers(ODD, 5)
    hold = HeldBatch(ODD, 0.1, (5,), compiled)
    expected = hold(state.T, control.T, push.T).copy()
    copied = pickle.loads(pickle.dumps(hold))
    np.testing.assert_array_equal(copied(state.T, control.T, push.T), expected)
    step = HeldStep(ODD, 0.1, compiled)
    arguments = [tuple(part[0].tolist()) for part in (state, control, push)]
    assert pickle.loads(pickle.dumps(step)).run(*arguments) == step.run(*arguments)


def test_a_recording_keeps_the_order_and_drops_what_is_not_needed():
    def function(values):
        x, y = values
        share = x / y
        return [(x + y) * (x + y), 2.0 - y, x + 0.0, x + -0.0, share - share + x, y]

    recorded = straight_line(function, ["x", "y"])
    run = ArrayFunction(recorded, (3,))
    x, y = np.array([0.1, -0.0, 1e100]), np.array([0.7, -2.0, 3.0])
    run.inputs[:] = x, y
    for found, expected in zip(run(), function([x, y]), strict=True):
        np.testing.assert_array_equal(found, expected)
        np.testing.assert_array_equal(np.signbit(found), np.signbit(expected))
    # Equal operations once, and none for a sum with -0.0, which only one with 0.0 changes.
    symbols = [operation.symbol for operation in recorded.operations.values()]
    assert sorted(symbols) == sorted("/+*-+-+")
    lean = straight_line(lambda values: [values[0] * 2.0, values[1]][:1], ["x", "y"])
    assert len(lean.operations) == 1


@pytest.mark.parametrize("compiled", BACKENDS)
def test_no_push_is_a_push_of_zero_bit_for_bit(compiled):
    state, control, _ = numbers(ODD, 40)
    zeros = np.zeros_like(state)
    pushed, calm = (HeldBatch(ODD, 0.1, (40,), compiled, pushed=flag) for flag in (True, False))
    tolerance = 1e-14 if compiled else 0.0
    expected = pushed(state.T, control.T, zeros.T)
    np.testing.assert_allclose(calm(state.T, control.T), expected, rtol=tolerance, atol=tolerance)
    runs = [HeldStep(ODD, 0.1, compiled, pushed=flag).run for flag in (True, False)]
    for x, u in zip(map(tuple, state.tolist()), map(tuple, control.tolist()), strict=True):
        assert runs[0](x, u, (0.0,) * 4) == runs[1](x, u)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda values: [values[0] if values[0] else 0.0], "must not branch"),
        (lambda values: [values[0] * math.inf], "no finite number"),
        (lambda values: [values[0] * "2"], "no finite number"),
    ],
)
def test_what_cannot_be_recorded_is_refused(function, message):
    with pytest.raises(TypeError, match=message):
        straight_line(function, ["x"])


def test_a_missing_numba_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "numba", None)
    compiled.compiled_function.cache_clear()
    with pytest.raises(ImportError, match=r"lagros\[fast\]"):
        HeldBatch(CartPole(), 0.1, (2,), compiled=True)


VECTORS = {
    "lagros/CartPole-v0": {"num_envs": 2},
    "lagros/Spacecraft-v0": {"num_envs": 4, "num_agents": 2, "preset": "open"},
}


@needs_numba
@pytest.mark.parametrize("name", VECTORS)
def test_many_worlds_are_compiled_where_numba_is_installed(name):
    assert gym.make_vec(name, **VECTORS[name]).unwrapped.compiled is True
    assert gym.make_vec(name, **VECTORS[name], compiled=False).unwrapped.compiled is False


@pytest.mark.parametrize("name", VECTORS)
def test_many_worlds_do_without_numba(name, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "numba", None)
    has_numba.cache_clear()
    compiled.compiled_function.cache_clear()
    try:
        envs = gym.make_vec(name, **VECTORS[name])
        assert envs.unwrapped.compiled is False
        envs.reset(seed=0)
        envs.step(envs.action_space.sample())
        with pytest.raises(ImportError, match=r"lagros\[fast\]"):
            gym.make_vec(name, **VECTORS[name], compiled=True)
    finally:
        has_numba.cache_clear()


@needs_numba
def test_nothing_that_is_compiled_is_written_or_read(run_python, tmp_path):
    """What numba keeps on disk are pickles."""
    script = """
import gymnasium as gym, lagros_envs, sys
sys.addaudithook(lambda event, _: event == "pickle.find_class" and sys.exit("unpickled"))
envs = gym.make_vec("lagros/CartPole-v0", num_envs=2)
assert envs.unwrapped.compiled
envs.reset(seed=0)
envs.step(envs.action_space.sample())
"""
    run_python(script, HOME=str(tmp_path), XDG_CACHE_HOME=str(tmp_path / "cache"))
    assert list(tmp_path.iterdir()) == []


@needs_numba
def test_threads_may_compile_at_once():
    source = "def held(x):\n    return x + 1.5\n"
    with ThreadPoolExecutor(4) as pool:
        found = list(
            pool.map(lambda x: compiled.compiled_function(source)(x), [1.0, 2.0, 3.0, 4.0])
        )
    assert found == [2.5, 3.5, 4.5, 5.5]


# The episode goes on after the force that nothing stands under.
@pytest.mark.filterwarnings("ignore:.*even though this environment has already")
@needs_numba
@pytest.mark.parametrize("kind", ["none", "gust"])
def test_a_compiled_environment_flies_the_same_episode(kind, hold):
    envs = [
        gym.make("lagros/CartPole-v0", disturbance=kind, compiled=flag) for flag in (False, True)
    ]
    for seed in (1, 2):
        observations = [env.reset(seed=seed)[0] for env in envs]
        for step in range(90):
            state = envs[0].unwrapped.state
            action = hold(state, observations[0][4:8]) if step != 40 else np.array([1e200])
            (first, *others), (second, *same) = (env.step(action) for env in envs)
            np.testing.assert_array_equal(first, second)
            assert others[:3] == same[:3]
            assert all(np.array_equal(others[3][key], same[3][key]) for key in others[3])


@needs_numba
@pytest.mark.parametrize("mode", ["next_step", "same_step"])
def test_compiled_worlds_fly_the_same_episodes(mode, hold):
    first, second = (
        gym.make_vec(
            "lagros/CartPole-v0",
            num_envs=5,
            disturbance="uniform",
            compiled=flag,
            autoreset_mode=mode,
        )
        for flag in (False, True)
    )
    first.reset(seed=3)
    second.reset(seed=3)
    for _ in range(100):
        ours, theirs = (
            envs.step(hold(envs.unwrapped.state, envs.unwrapped._goal.T))
            for envs in (first, second)
        )
        for one, other in zip(ours[:4], theirs[:4], strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(
            first.unwrapped.state, second.unwrapped.state, rtol=1e-9, atol=1e-9
        )


@needs_numba
def test_compiled_spacecraft_fly_the_same_episodes():
    first, second = (
        gym.make_vec(
            "lagros/Spacecraft-v0",
            num_envs=6,
            num_agents=3,
            preset="open",
            disturbance="uniform",
            compiled=flag,
        )
        for flag in (False, True)
    )
    first.reset(seed=3)
    second.reset(seed=3)
    rng = np.random.default_rng(0)
    for _ in range(40):
        actions = rng.uniform(0.0, 0.5, (6, 8)).astype(np.float32)
        first.step(actions)
        second.step(actions)
        np.testing.assert_allclose(first.unwrapped.states, second.unwrapped.states, atol=1e-11)


def test_any_system_that_states_its_derivative_can_be_recorded():
    """A pendulum that nobody has written before."""
    pendulum = SimpleNamespace(
        state_dim=2,
        control_dim=1,
        derivative=lambda x, u, functions: (x[1], u[0] - 9.8 * functions.sin(x[0])),
    )
    hold = HeldBatch(pendulum, 0.2, (3,))
    state, control = np.array([[0.1, 1.0, -2.0], [0.0, 0.3, 1.0]]), np.array([[0.5, 0.0, -1.0]])
    expected = hold_step(pendulum, state.T, control.T, 0.2, np.zeros((3, 2)))
    np.testing.assert_array_equal(hold(state, control, np.zeros((2, 3))).T, expected)

"""Environments as Python's objects: copies, pickles, specs in JSON, threads, two at a time."""

import copy
import dataclasses
import importlib.util
import json
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

from lagros_envs.conventions import settings_of
from lagros_envs.tasks import SHIPPED
from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_envs.tasks.spacecraft import scenarios
from lagros_envs.tasks.spacecraft.physics import Spacecraft
from lagros_envs.tasks.spacecraft.scenarios import PRESETS
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_envs.tube import PaperTube
from tests.envs.subjects import CARTPOLE, EVERY, IDS, PETTINGZOO, SHORT, SINGLE, SPACECRAFT, VECTOR

needs_numba = pytest.mark.skipif(
    importlib.util.find_spec("numba") is None, reason="numba is not installed"
)
MARKS = {name: (needs_numba,) if "compiled" in name else () for name in EVERY}
SUBJECTS = [pytest.param(name, marks=marks) for name, marks in MARKS.items()]
WAYS = {
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda value: pickle.loads(pickle.dumps(value)),
}
# The wrappers of others share what they wrap when they are copied by `copy.copy`.
COPIES = [
    pytest.param(name, way, marks=MARKS[name])
    for name, subject in EVERY.items()
    for way in WAYS
    if way != "copy" or subject.own_copy
]
# After how many steps of a run; None before the first reset. Episodes last eight steps at most.
MOMENTS = (None, 0, 3, 8)


def players(name, count=1, **arguments):
    subject = EVERY[name]
    settings = SHORT[CARTPOLE if subject.cartpole else SPACECRAFT]
    return subject.players(count, disturbance="gust", settings=settings, **arguments)


def begin(player, moment):
    if moment is not None:
        player.reset(seed=3)
        player.play(moment, seed=1)
    return player


def run_from(player, moment):
    first = [player.reset(seed=4)] if moment is None else []
    return [*first, *player.play()]


@pytest.mark.parametrize("moment", MOMENTS)
@pytest.mark.parametrize(("name", "way"), COPIES)
def test_a_copy_goes_on_as_the_original_and_apart_from_it(name, way, moment):
    (player,) = players(name)
    begin(player, moment)
    make = WAYS[way]
    before, after = (type(player)(make(player.env), player.over) for _ in range(2))
    runs = [run_from(one, moment) for one in (before, player, after)]
    np.testing.assert_equal(runs[1], runs[0])
    np.testing.assert_equal(runs[2], runs[0])


@pytest.mark.parametrize("copied", [False, True])
@pytest.mark.parametrize("name", SUBJECTS)
def test_what_an_environment_has_said_it_does_not_take_back(name, copied):
    (player,) = players(name)
    player.reset(seed=3)
    if copied:
        player.env = copy.deepcopy(player.env)
    random = np.random.default_rng(0)
    said = []
    for _ in range(20):
        result = player.step(random)
        states = [getattr(player.env.unwrapped, name, None) for name in ("state", "states")]
        states = [value() if callable(value) else value for value in states]
        said.append((result, states))
    kept = copy.deepcopy(said)
    player.play(10, seed=1)
    player.reset(seed=4)
    np.testing.assert_equal(said, kept)


@pytest.mark.parametrize("name", SUBJECTS)
def test_two_at_a_time_go_on_as_one_after_the_other(name):
    alone = [begin(*pair).play() for pair in zip(players(name, 2), (0, 5), strict=True)]
    together = [begin(*pair) for pair in zip(players(name, 2), (0, 5), strict=True)]
    randoms = [np.random.default_rng(0) for _ in together]
    runs = [[], []]
    for _ in range(25):
        for player, random, run in zip(together, randoms, runs, strict=True):
            run.append(player.step(random))
    np.testing.assert_equal(runs, alone)


@pytest.mark.parametrize("name", SUBJECTS)
def test_several_threads_disturb_no_one(name):
    alone = begin(players(name)[0], 0).play(40)
    with ThreadPoolExecutor(4) as pool:
        runs = list(pool.map(lambda player: begin(player, 0).play(40), players(name, 4)))
    for run in runs:
        np.testing.assert_equal(run, alone)


# Pictures.


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", ["cart-pole", "spacecraft", "spacecraft at once"])
def test_a_copy_draws_on_as_the_original(name, way):
    pytest.importorskip("pygame")
    (player,) = players(name, render_mode="rgb_array")
    player.reset(seed=3)
    for _ in range(3):
        player.play(1)
        player.env.render()
    other = type(player)(WAYS[way](player.env))
    frames = []
    for one in (player, other):
        one.play(1)
        frames.append(one.env.render())
    np.testing.assert_array_equal(*frames)
    player.env.close()
    np.testing.assert_array_equal(other.env.render(), frames[1])


def test_two_windows_and_a_library_that_closes_pygame():
    pygame = pytest.importorskip("pygame")
    first, second = (players(name, render_mode="human")[0] for name in ("cart-pole", "spacecraft"))
    picture = players("cart-pole", render_mode="rgb_array")[0]
    for player in (first, second, picture):
        player.reset(seed=0)
    assert pygame.display.get_surface().get_size() == (840, 640)
    first.play(1)
    assert pygame.display.get_surface().get_size() == (800, 400)
    frame = picture.env.render()
    second.env.close()
    first.play(1)
    pygame.quit()  # as the environments of Gymnasium do when they are closed
    first.play(1)
    np.testing.assert_array_equal(picture.env.render(), frame)
    first.env.close()
    first.env.close()
    assert pygame.display.get_surface() is None


# Specs.

METRICS = {CARTPOLE: np.diag([1.0, 8.0, 0.5, 2.0]), SPACECRAFT: np.diag([2.0, 2, 1, 3, 3, 1])}
SETTINGS = {
    CARTPOLE: CartPoleSettings(
        system=CartPole(cart_friction=2.0, half_length=np.float32(0.4)),
        time_limit=np.float64(3.0),
        force_limit=50,
        tube=PaperTube(2.0, 0.5),
    ),
    SPACECRAFT: SpacecraftSettings(Spacecraft(mass=2.0), time_limit=3.0, sensing_radius=1.5),
}
CHANGES = {
    "nothing": lambda name: {},
    "settings": lambda name: {"settings": SETTINGS[name]},
    "some of the settings": lambda name: {"settings": {"time_limit": 3.0}},
    "worst": lambda name: {"disturbance": "worst", "metric": METRICS[name]},
    "numbers of NumPy": lambda name: {
        "disturbance": "uniform",
        "disturbance_bound": np.float32(0.3),
        "disturbance_channels": np.arange(len(METRICS[name])) > 1,
    },
    "a picture": lambda name: {"render_mode": "rgb_array"},
}
ONLY_SPACECRAFT = {
    "a name": {"preset": "crossing"},
    "a preset": {"preset": PRESETS["swarm"]},
    "some of a preset": {"preset": {"agents": 1, "obstacle_count": [1, 2]}},
}
CASES = [(name, CHANGES[key](name)) for name in IDS for key in CHANGES]
CASES += [(SPACECRAFT, change) for change in ONLY_SPACECRAFT.values()]
BACK = {
    "JSON": lambda spec: EnvSpec.from_json(spec.to_json()),
    "as it is": lambda spec: spec,
    "a pickle": lambda spec: pickle.loads(pickle.dumps(spec)),
}


def same_world(first, second):
    """What the two were made with, then what they do."""
    for name in ("settings", "preset", "num_envs", "autoreset_mode", "step_limit", "render_mode"):
        assert getattr(first, name, None) == getattr(second, name, None)
    assert first.disturbance == second.disturbance
    assert hash(first.disturbance) == hash(second.disturbance)
    if first.disturbance.kind == "worst":
        return
    actions = [np.full(first.action_space.shape, 0.1, np.float32)] * 2
    runs = [[env.reset(seed=2), *(env.step(one) for one in actions)] for env in (first, second)]
    np.testing.assert_equal(*runs)


@pytest.mark.parametrize("way", BACK)
@pytest.mark.parametrize(("name", "change"), CASES)
def test_a_spec_makes_the_same_environment_again(name, change, way):
    env = gym.make(name, **change)
    again = gym.make(BACK[way](env.spec))
    same_world(env.unwrapped, again.unwrapped)
    assert again.spec == env.spec


@pytest.mark.parametrize("way", BACK)
@pytest.mark.parametrize(("name", "change"), CASES)
def test_a_spec_makes_the_same_worlds_again(name, change, way):
    change = {key: value for key, value in change.items() if key != "render_mode"}
    mode = gym.vector.AutoresetMode.DISABLED
    envs = gym.make_vec(name, num_envs=np.int64(3), autoreset_mode=mode, compiled=False, **change)
    again = gym.make_vec(BACK[way](envs.spec))
    same_world(envs.unwrapped, again.unwrapped)


@pytest.mark.parametrize("name", IDS)
def test_a_limit_of_steps_comes_back_with_the_spec(name):
    limits = {"max_episode_steps": 20}
    spec = EnvSpec.from_json(gym.make(name, **limits).spec.to_json())
    assert gym.make(spec).spec.max_episode_steps == 20
    spec = EnvSpec.from_json(gym.make_vec(name, num_envs=2, **limits).spec.to_json())
    assert gym.make_vec(spec).unwrapped.step_limit == 20


@pytest.mark.parametrize("name", IDS)
def test_what_json_cannot_hold_is_refused_when_it_is_written_or_read(name):
    def push(now):
        return 0.0 * now.state

    with pytest.raises(TypeError, match="JSON"):
        gym.make(name, disturbance=push).spec.to_json()
    # A callable dataclass is written as its fields; nothing flies another disturbance for it.
    written = gym.make(name, disturbance=Gale(0.1)).spec.to_json()
    with pytest.raises(ValueError, match=r"disturbance=\{'strength': 0.1\} is not known"):
        gym.make(EnvSpec.from_json(written))


@dataclasses.dataclass(frozen=True)
class Gale:
    """A disturbance that a user might write."""

    strength: float

    def __call__(self, now):
        return self.strength + 0.0 * now.state


@dataclasses.dataclass(frozen=True)
class OtherCart(CartPole):
    """An equation of motion that JSON would lose."""


def test_a_system_that_a_spec_would_lose_is_refused():
    with pytest.raises(ValueError, match=r"system=OtherCart\(.* must be a CartPole"):
        CartPoleSettings(system=OtherCart())


# Settings, presets and scenarios as values.

VALUES = {
    "cart-pole": SETTINGS[CARTPOLE],
    "spacecraft": SETTINGS[SPACECRAFT],
    "preset": dataclasses.replace(PRESETS["paper"], obstacle_count=[np.int64(1), 2]),
    "scenario": PRESETS["paper"].sample(np.random.default_rng(0)),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", VALUES)
def test_values_are_equal_to_their_copies(name, way):
    value = VALUES[name]
    other = WAYS[way](value)
    assert other == value
    assert hash(other) == hash(value)
    assert len({value, other}) == 1


def test_scenarios_differ_by_any_entry_and_stay_read_only():
    value = VALUES["scenario"]
    assert value != PRESETS["paper"].sample(np.random.default_rng(1))
    assert value != dataclasses.replace(value, headings=value.headings + 1.0)
    assert value != "scenario"
    for way in WAYS.values():
        with pytest.raises(ValueError, match="read-only"):
            way(value).goals[0, 0] = 9.0


@pytest.mark.parametrize("name", ["cart-pole", "spacecraft", "preset"])
def test_settings_come_back_from_json(name):
    value = VALUES[name]
    written = json.loads(json.dumps(dataclasses.asdict(value)))
    if name == "preset":
        assert scenarios.preset_named(written) == value
    else:
        assert settings_of(type(value)(), written) == value


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"time_limt": 3.0}, r"settings has no entry 'time_limt'; .* Did you mean 'time_limit'\?"),
        ({"system": {"mass": 3.0}}, r"settings\.system has no entry 'mass'"),
        ({"tube": 3.0}, r"settings\.tube=3\.0 must be a PaperTube or a dictionary of its fields"),
        ("short", "settings='short' must be a CartPoleSettings or a dictionary"),
        ([3.0], r"settings=\[3\.0\] must be"),
        ({"time_limit": "3"}, "time_limit='3' must be a finite number"),
        ({"goal_range": 1e39}, "goal_range=1e[+]39 must be at most 1e[+]09"),
        ({"system": {"pole_mass": 1e-300}}, "pole_mass=1e-300 must be at least 1e-09"),
    ],
)
def test_settings_that_are_none_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        gym.make(CARTPOLE, settings=given)
    with pytest.raises(ValueError, match="preset has no entry 'agent'"):
        gym.make(SPACECRAFT, preset={"agent": 3})
    with pytest.raises(ValueError, match="preset=3 must be a Preset or a dictionary"):
        gym.make(SPACECRAFT, preset=3)


def test_every_environment_is_walked_through():
    assert {*SINGLE, *VECTOR, *PETTINGZOO} == {*EVERY}
    # In a process of its own: other tests register tasks.
    code = "import gymnasium, lagros_envs; print(*gymnasium.registry)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    registered = {name for name in run.stdout.split() if name.startswith("lagros/")}
    # Tasks of one body are walked through by `test_tasks`.
    assert registered == {f"lagros/{one.title}-v0" for one in SHIPPED.values()}

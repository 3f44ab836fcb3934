"""Gymnasium's and PettingZoo's conventions, over every environment and every way to break them."""

import copy
import math
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import RescaleObservation, TimeAwareObservation

from lagros_envs import conventions
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_envs.tasks.spacecraft.scenarios import PRESETS, preset_named
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings, settings_for
from tests.envs.subjects import CARTPOLE, EVERY, IDS, PETTINGZOO, SHORT, SINGLE, SPACECRAFT, VECTOR

# What is asked before a step is the same in every mode of autoreset.
PLAIN = [name for name in EVERY if not name.startswith("compiled") and ", same_step" not in name]
DEFAULTS = {CARTPOLE: CartPoleSettings(), SPACECRAFT: SpacecraftSettings()}
AFTER_THE_END = "even though this environment has already returned"


def player(name, **arguments):
    return EVERY[name].players(1, **arguments)[0]


def begun(name, steps=2, **arguments):
    one = player(name, disturbance="uniform", **arguments)
    one.reset(seed=3)
    one.play(steps, seed=1)
    return one


def bare(env):
    """The environment of ours, without the wrappers of others."""
    return env.unwrapped


def unchanged(one, refused, *arguments, **options):
    """Refuse something, and go on as if nothing had been asked."""
    other = type(one)(copy.deepcopy(one.env), one.over)
    with pytest.raises(ValueError, match=options.pop("match")) as caught:
        refused(*arguments, **options)
    assert "\n" not in str(caught.value)
    np.testing.assert_equal(one.play(6), other.play(6))
    np.testing.assert_equal(one.reset(), other.reset())


# Options of a reset.

NUMBERS = np.zeros(4)
BAD_OPTIONS = [
    ({"gaol": 1.0}, r"no entry 'gaol'; its entries may be .*goal.* Did you mean 'goal'\?"),
    ({"initial_state": NUMBERS, 3: 4}, "no entry 3"),
    ({"initial_state": NUMBERS, "goal": "1.0"}, r"options\['goal'\]='1.0' must be finite numbers"),
    ({"initial_state": NUMBERS, "goal": 1e39}, r"options\['goal'\] holds 1e\+39"),
    ({"initial_state": NUMBERS, "goal": -1e10}, r"options\['goal'\] holds -1e\+10"),
    ({"initial_state": NUMBERS, "goal": math.nan}, r"options\['goal'\] holds nan"),
    ({"initial_state": NUMBERS, "goal": True}, r"options\['goal'\]=True"),
    ({"goal": 1.0, "initial_state": [True, 0, 0, 0]}, r"options\['initial_state'\]=\[.*True, 0"),
    ({"initial_state": NUMBERS, "goal": None}, r"options\['goal'\]=None"),
    ({"initial_state": NUMBERS, "goal": 1j}, r"options\['goal'\]=1j"),
    ({"initial_state": NUMBERS, "goal": np.ma.masked}, r"options\['goal'\]=masked"),
    ({"initial_state": NUMBERS, "goal": [[0], [0, 1]]}, r"options\['goal'\]="),
    ({"goal": 1.0, "initial_state": [0, 1.6, 0, 0]}, "already fallen"),
    ({"goal": 1.0, "initial_state": ["0"] * 4}, r"options\['initial_state'\]="),
    ({"goal": 1.0, "nominal": np.zeros((2, 4))}, r"options\['nominal'\] has shape \(2, 4\)"),
    ({"goal": 1.0, "nominal": np.full((91, 4), 1e200)}, r"options\['nominal'\] holds 1e\+200"),
]
BAD_SPACECRAFT_OPTIONS = [
    ({"senario": None}, r"no entry 'senario'; its entries may be .* Did you mean 'scenario"),
    ({"nominal": "straight on"}, r"options\['nominal'\]='straight on'"),
    ({"nominal": np.zeros((3, 6))}, r"options\['nominal'\] has shape"),
]


def of_worlds(options):
    """The options of one cart-pole for three of them."""
    batched = (np.ndarray, list, float)
    return {key: [value] * 3 if type(value) in batched else value for key, value in options.items()}


@pytest.mark.parametrize(("options", "match"), BAD_OPTIONS)
@pytest.mark.parametrize("name", ["cart-pole", "cart-pole of make"])
def test_options_of_the_cartpole_that_make_no_sense_change_nothing(name, options, match):
    one = begun(name)
    unchanged(one, one.env.reset, seed=9, options=options, match=match)


@pytest.mark.parametrize(("options", "match"), BAD_OPTIONS)
@pytest.mark.parametrize("name", [name for name in PLAIN if name.startswith("cart-poles")])
def test_options_of_many_cartpoles_that_make_no_sense_change_nothing(name, options, match):
    one = begun(name)
    options = of_worlds(options)
    match = match.replace(r"\(2, 4", r"\(3, 2, 4")
    unchanged(one, one.env.reset, seed=9, options=options, match=match)


@pytest.mark.parametrize(("options", "match"), BAD_SPACECRAFT_OPTIONS)
@pytest.mark.parametrize("name", [name for name in PLAIN if not EVERY[name].cartpole])
def test_options_of_spacecraft_that_make_no_sense_change_nothing(name, options, match):
    one = begun(name)
    unchanged(one, one.env.reset, seed=9, options=options, match=match)


@pytest.mark.parametrize("name", [name for name in PLAIN if not EVERY[name].cartpole])
def test_a_scenario_that_does_not_fit_changes_nothing(name):
    one = begun(name)
    crowd = PRESETS["open"].sample(np.random.default_rng(0), 7)
    for given, match in ((crowd, "has 7 agents"), ("file.json", "has a str")):
        others = [None] * (getattr(one.env, "num_worlds", 1) - 1)
        options = {"scenarios": [*others, given]} if name in VECTOR else {"scenario": given}
        unchanged(one, one.env.reset, seed=9, options=options, match=match)


@pytest.mark.parametrize("options", [[], ["goal"], "goal", 3, {1, 2}])
@pytest.mark.parametrize("name", PLAIN)
def test_options_are_a_dictionary(name, options):
    one = begun(name)
    match = "options=.* must be a dictionary or None"
    unchanged(one, one.env.reset, options=options, match=match)


@pytest.mark.parametrize("name", PLAIN)
def test_a_first_reset_that_is_refused_starts_nothing(name):
    one = player(name)
    with pytest.raises(ValueError, match="no entry 'gaol'"):
        one.env.reset(seed=0, options={"gaol": 1.0})
    if name in ("cart-pole of make", "spacecraft of make", "spacecraft in turn"):
        return  # wrappers of others believe that it was reset
    with pytest.raises(RuntimeError, match="call reset"):
        one.env.step(one.action(np.random.default_rng(0)))


@pytest.mark.parametrize("name", [name for name in PLAIN if "make" not in name])
def test_what_only_an_episode_has_is_not_there_before_one(name):
    one = player(name)
    env = one.env.unwrapped
    of_episode = ("state", "states", "time", "scenario", "scenarios", "render")
    found = [what for what in of_episode if hasattr(type(env), what)]
    assert len(found) > 1
    for what in found:
        if what == "render" and not env.metadata["render_modes"]:
            continue
        method = callable(getattr(type(env), what))
        if what == "render":
            env.render_mode = "rgb_array"
        with pytest.raises(RuntimeError, match=rf"call reset\(\) before {what}"):
            getattr(env, what)() if method else getattr(env, what)
        assert method == hasattr(env, what)
    one.reset(seed=0)
    for what in found:
        value = getattr(env, what)
        assert value() is not None if callable(value) and what != "render" else value is not None


# Seeds.


@pytest.mark.parametrize("seed", [-1, 1.5, 2.0, math.nan, True, "3", np.float64(3.0), 1 << 200, 3j])
@pytest.mark.parametrize("name", PLAIN)
def test_seeds_that_are_none_change_nothing(name, seed):
    one = begun(name)
    unchanged(one, one.env.reset, seed=seed, match="seed")


@pytest.mark.parametrize("seeds", [b"abc", bytearray(b"abc"), "abc", np.array(5), np.ones((3, 1))])
@pytest.mark.parametrize("name", [name for name in PLAIN if name in VECTOR])
def test_what_is_no_list_of_seeds_changes_nothing(name, seeds):
    one = begun(name)
    worlds = one.env.num_worlds
    seeds = seeds if np.ndim(seeds) == 0 and not isinstance(seeds, bytes | str) else seeds[:worlds]
    unchanged(one, one.env.reset, seed=seeds, match="seed=")


@pytest.mark.parametrize("kind", [list, tuple, np.array, lambda seeds: np.array(seeds, object)])
@pytest.mark.parametrize("name", [name for name in PLAIN if name in VECTOR])
def test_seeds_may_be_any_list_of_whole_numbers(name, kind):
    one, other = EVERY[name].players(2)
    seeds = list(range(5, 5 + one.env.num_worlds))
    np.testing.assert_equal(one.reset(seed=kind(seeds)), other.reset(seed=5))


@pytest.mark.parametrize("entry", [-1, 1.5, True, "3", math.nan])
@pytest.mark.parametrize("name", [name for name in PLAIN if name in VECTOR])
def test_lists_of_seeds_with_one_that_is_none_change_nothing(name, entry):
    one = begun(name)
    worlds = one.env.num_worlds
    unchanged(one, one.env.reset, seed=[*range(worlds - 1), entry], match="seed=")
    match = f"must be {worlds} non-negative integers, one per world"
    unchanged(one, one.env.reset, seed=[1] * (worlds + 1), match=match)
    unchanged(one, one.env.reset, seed=[], match=match)


@pytest.mark.parametrize("name", PLAIN)
def test_a_seed_may_be_any_whole_number_and_none_goes_on_drawing(name):
    one, other = player(name), player(name)
    for seed in (5, 2**63 + 3, 2**100):
        np.testing.assert_equal(one.reset(seed=seed), other.reset(seed=seed))
    for kind in (np.int64, np.uint8):
        np.testing.assert_equal(one.reset(seed=kind(5)), other.reset(seed=5))
    seen = [repr(one.reset()) for _ in range(4)]
    assert len({*seen, repr(one.reset(seed=5))}) == 5


@pytest.mark.parametrize("name", [*SINGLE, *VECTOR])
def test_the_seed_can_be_read(name):
    env = bare(player(name).env)
    env.reset(seed=5)
    assert env.np_random_seed == 5
    assert isinstance(env.np_random, np.random.Generator)
    env.np_random = np.random.default_rng(1)
    assert env.np_random_seed == -1
    drawn = env.reset()[0]
    env.np_random = np.random.default_rng(1)
    np.testing.assert_array_equal(env.reset()[0], drawn)


# Actions.

NONE_AT_ALL = {
    "text": lambda good: "left",
    "texts": lambda good: good.astype(str),
    "dates": lambda good: np.full(good.shape, np.datetime64("2021-05-03")),
    "durations": lambda good: np.full(good.shape, np.timedelta64(1, "s")),
    "objects": lambda good: good.astype(object),
    "a mask": lambda good: np.ma.masked_array(good, np.ones(good.shape, bool)),
    "complex numbers": lambda good: good.astype(complex),
    "truth values": lambda good: good.astype(bool),
    "records": lambda good: np.zeros(good.shape, [("force", float)]),
    "None": lambda good: None,
    "a dictionary": lambda good: {"force": 1.0},
    "a class": lambda good: float,
    "one number": lambda good: 0.5,
    "too many": lambda good: np.concatenate([good, good], axis=-1),
    "another axis": lambda good: good[None],
    "nothing": lambda good: good[..., :0],
    "lists of different lengths": lambda good: [[0.0], [0.0, 0.0]],
    "nan": lambda good: good * np.nan,
    "infinity": lambda good: good + np.inf,
    "minus infinity": lambda good: good - np.inf,
}


def acting(name, one, change):
    """An action changed, as the environment takes it."""
    if name in PETTINGZOO and name != "spacecraft in turn":
        return {agent: change(np.ones(8, np.float32)) for agent in one.env.agents}
    if name == "spacecraft in turn":
        return change(np.ones(8, np.float32))
    return change(np.ones(one.env.action_space.shape, np.float32))


@pytest.mark.parametrize("kind", NONE_AT_ALL)
@pytest.mark.parametrize("name", [name for name in PLAIN if name != "spacecraft in turn"])
# The checker of `make` warns of what it looks at before we refuse it.
@pytest.mark.filterwarnings("ignore:.*")
def test_actions_that_are_none_change_nothing(name, kind):
    one = begun(name)
    action = acting(name, one, NONE_AT_ALL[kind])
    env = bare(one.env)
    unchanged(one, env.step, action, match="the action")


@pytest.mark.parametrize("kind", [np.float16, np.float64, np.longdouble, np.int8, np.uint64, list])
@pytest.mark.parametrize("name", [name for name in PLAIN if "make" not in name])
def test_numbers_of_every_kind_are_actions(name, kind):
    ones = [begun(name, steps=0) for _ in range(2)]
    change = (lambda good: good.tolist()) if kind is list else (lambda good: good.astype(kind))
    results = [
        one.env.step(acting(name, one, how))
        for one, how in zip(ones, (change, np.copy), strict=True)
    ]
    np.testing.assert_equal(*results)


HUGE = [1e25, 1e155, 1e300, float(np.finfo(float).max), float(np.finfo(np.float32).max)]


@pytest.mark.parametrize("size", HUGE)
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("name", [name for name in EVERY if name != "spacecraft in turn"])
@pytest.mark.filterwarnings("ignore:.*is not within the action space", "ignore:.*AFTER_THE_END")
def test_no_action_makes_a_reward_that_is_none(name, sign, size):
    one = begun(name, steps=1)
    if one.over:
        one.reset()
    result = bare(one.env).step(acting(name, one, lambda good: good * np.float64(sign * size)))
    rewards = np.array(list(result[1].values()) if name in PETTINGZOO else result[1])
    # A learner keeps them in single precision.
    assert np.all(np.isfinite(rewards.astype(np.float32)))
    infos = result[4].values() if name in PETTINGZOO else [result[4]]
    assert all(np.all(np.isfinite(np.float32(info["effort"]))) for info in infos)
    observations = result[0].values() if name in PETTINGZOO else [result[0]]
    assert all(np.all(np.isfinite(observation)) for observation in observations)


# Spaces.


def boxes(env):
    """Every space of an environment that describes what is observed."""
    env = bare(env)
    if hasattr(env, "possible_agents"):
        found = [env.observation_space(agent) for agent in env.possible_agents]
        found.append(env.state_space)
    else:
        found = [env.observation_space, getattr(env, "single_observation_space", spaces.Box(0, 1))]
    named = [getattr(env, name, None) for name in ("named_space", "named_state_space")]
    return found + [box for space in named if space is not None for box in space.values()]


@pytest.mark.parametrize("name", PLAIN)
def test_what_has_no_bound_is_declared_unbounded(name):
    for box in boxes(player(name).env):
        ends = np.concatenate([box.low.ravel(), box.high.ravel()])
        finite = ends[np.isfinite(ends)]
        # Times, masks, sines: nothing that pretends to a bound.
        assert np.all(np.abs(finite) <= 45.0)
        assert np.all(np.abs(box.sample()) < 100.0)


@pytest.mark.parametrize("name", [*SINGLE, *VECTOR])
def test_observations_lie_in_their_space(name):
    one = begun(name, steps=0, settings=SHORT[CARTPOLE if EVERY[name].cartpole else SPACECRAFT])
    random = np.random.default_rng(0)
    for _ in range(40):
        assert one.env.observation_space.contains(one.step(random)[0])


@pytest.mark.parametrize("name", IDS)
def test_unbounded_observations_are_not_rescaled(name):
    with pytest.raises(ValueError, match="unbounded components"):
        RescaleObservation(gym.make(name), -1.0, 1.0)


# What other libraries read.


def pairs(infos):
    """Success by both names, as often as it is given."""
    for key, value in infos.items():
        if isinstance(value, dict):
            yield from pairs(value)
        elif key == "success":
            yield value, infos["is_success"]


@pytest.mark.parametrize("name", PLAIN)
def test_success_has_the_name_that_other_libraries_read(name):
    settings = {"tube": {"steady_radius": 50.0}} if EVERY[name].cartpole else {"goal_radius": 3.0}
    one = begun(name, steps=0, settings=settings)
    seen = []
    for result in one.play(20):
        if result is not None:
            seen += pairs(result[-1])
    assert len(seen) >= 20
    assert any(np.any(success) for success, _ in seen)
    for success, same in seen:
        assert type(success) is type(same)
        np.testing.assert_array_equal(success, same)
    if name in VECTOR:
        assert not any(np.shares_memory(*pair) for pair in seen)


# Limits of steps.


@pytest.mark.parametrize("name", IDS)
def test_ids_are_registered_with_the_steps_of_their_task(name):
    steps = DEFAULTS[name].steps
    assert gym.make(name).spec.max_episode_steps == steps
    assert gym.make(name, max_episode_steps=-1).spec.max_episode_steps == steps
    assert gym.make_vec(name, num_envs=2).spec.max_episode_steps == steps
    observation, _ = TimeAwareObservation(gym.make(name)).reset(seed=0)
    assert observation[-1] == 0.0


def ends(env, name, steps):
    """The steps at which an episode that nothing disturbs is truncated."""
    still = np.zeros(env.action_space.shape, np.float32)
    # Gymnasium's vector environments hand the same options to each of theirs.
    ours = hasattr(env.unwrapped, "settings")
    upright = {"initial_state": np.zeros((*still.shape[:-1], 4) if ours else 4)}
    env.reset(seed=0, options=upright if name == CARTPOLE else {})
    return [at for at in range(1, steps + 1) if np.any(env.step(still)[3])]


@pytest.mark.parametrize("mode", ["sync", "async", "vector_entry_point", None])
@pytest.mark.parametrize("name", IDS)
def test_max_episode_steps_truncates(name, mode):
    if mode is None:
        env = gym.make(name, max_episode_steps=20)
    else:
        env = gym.make_vec(name, 2, mode, max_episode_steps=20)
    assert ends(env, name, 20) == [20]
    longest = env.get_attr("named_space")[0]["time"].high if mode == "sync" else None
    assert longest is None or longest == pytest.approx(DEFAULTS[name].time_limit)
    env.close()


@pytest.mark.parametrize("name", IDS)
def test_a_limit_changes_nothing_before_it(name):
    change = {"disturbance": "uniform", "autoreset_mode": "disabled", "compiled": False}
    envs = [gym.make_vec(name, 3, max_episode_steps=limit, **change) for limit in (5, 20)]
    still = np.zeros(envs[0].action_space.shape, np.float32)
    runs = [[env.reset(seed=[1, 2, 3]), *(env.step(still) for _ in range(4))] for env in envs]
    np.testing.assert_equal(*runs)


@pytest.mark.parametrize("name", IDS)
def test_a_shorter_task_ends_at_its_own_limit(name):
    settings = {"time_limit": 1.0}
    assert ends(gym.make(name, settings=settings), name, 10) == [10]
    assert ends(gym.make_vec(name, 2, settings=settings), name, 10) == [10]
    assert gym.make_vec(name, 2, settings=settings).spec.max_episode_steps == 10


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_is_made_by_its_name_and_lasts_as_long_as_it_says(preset):
    env = gym.make(SPACECRAFT, preset=preset)
    steps = settings_for(preset_named(preset).for_agents(1)).steps
    assert env.spec.max_episode_steps == env.unwrapped.settings.steps == steps
    assert gym.make(env.spec).spec.max_episode_steps == steps
    for count in {1, PRESETS[preset].agents}:
        worlds = gym.make_vec(SPACECRAFT, 2 * count, preset=preset, num_agents=count)
        longest = settings_for(preset_named(preset).for_agents(count)).steps
        assert worlds.spec.max_episode_steps == worlds.unwrapped.settings.steps == longest
        sooner = gym.make_vec(
            SPACECRAFT, count, preset=preset, num_agents=count, max_episode_steps=9
        )
        assert ends(sooner, SPACECRAFT, 9) == [9]
    assert ends(gym.make(SPACECRAFT, preset=preset, max_episode_steps=9), SPACECRAFT, 9) == [9]


@pytest.mark.parametrize("name", IDS)
def test_a_longer_task_is_never_cut_in_silence(name):
    settings = {"time_limit": 60.0}
    for make in (gym.make, gym.make_vec):
        if name == SPACECRAFT:
            assert make(name, settings=settings).spec.max_episode_steps == 600
        else:
            with pytest.raises(ValueError, match="pass max_episode_steps=600, too"):
                make(name, settings=settings)
        env = make(name, settings=settings, max_episode_steps=600)
        assert env.spec.max_episode_steps == env.unwrapped.step_limit == 600
        again = make(env.spec)
        assert again.spec.max_episode_steps == 600
        with pytest.raises(ValueError, match="max_episode_steps=1000 is beyond"):
            make(name, max_episode_steps=1000)
    assert gym.make(name, settings=settings, max_episode_steps=-1).spec.max_episode_steps == 600


def test_without_gymnasium_around_it_a_task_is_as_long_as_its_settings():
    settings = CartPoleSettings(time_limit=18.0)
    env = SINGLE["cart-pole"].make(settings=settings)
    assert ends(env, CARTPOLE, 180) == [180]
    env.spec = gym.spec(CARTPOLE)
    assert env.spec.max_episode_steps == 180


@pytest.mark.parametrize("limit", [0, -3, 2.5, True, "20"])
def test_limits_that_are_none_are_refused(limit):
    for name in IDS:
        with pytest.raises(ValueError, match=r"max_episode_steps=.* must be a whole number"):
            gym.make_vec(name, 2, max_episode_steps=limit)


# After the end.


def end(name):
    """A player whose episode has just ended, and who does not reset."""
    settings = SHORT[CARTPOLE if EVERY[name].cartpole else SPACECRAFT]
    one = player(name, settings=settings)
    one.reset(seed=0)
    random = np.random.default_rng(0)
    while not one.over:
        one.step(random)
    return one, random


@pytest.mark.parametrize("name", [name for name in PLAIN if name in SINGLE or "disabled" in name])
def test_a_step_after_the_end_warns_once(name):
    one, random = end(name)
    with pytest.warns(UserWarning, match=AFTER_THE_END):
        one.env.step(one.action(random))
    one.env.step(one.action(random))
    one.reset(seed=1)
    one.step(random)


@pytest.mark.parametrize("name", [name for name in VECTOR if "disabled" not in name])
def test_worlds_that_start_anew_are_never_warned_of(name):
    begun(name, steps=0, settings={"time_limit": 0.3}).play(12)


@pytest.mark.parametrize("name", PETTINGZOO)
def test_pettingzoo_is_warned_as_its_own_environments_are(name, caplog):
    one, random = end(name)
    assert not caplog.records
    last = bare(one.env) if name == "spacecraft at once" else one.env
    result = last.step({} if name == "spacecraft at once" else random.random(8))
    assert result in (({}, {}, {}, {}, {}), None)
    assert "step() called after all agents are terminated or truncated" in caplog.text


def test_who_means_to_fly_on_is_not_warned():
    one, random = end("cart-pole")
    with warnings.catch_warnings(), conventions.beyond_the_end():
        one.env.step(one.action(random))


# The rest.


@pytest.mark.parametrize("name", [*SINGLE, "spacecraft at once"])
def test_a_render_mode_is_known_or_refused(name):
    env = bare(player(name).env)
    assert env.metadata["render_modes"] == ["human", "rgb_array"]
    assert env.metadata["render_fps"] > 0
    for mode in ("ansi", "RGB_array", 3):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Gymnasium's own, before ours is asked
            with pytest.raises((ValueError, AttributeError), match=r"render_mode|endswith"):
                player(name, render_mode=mode)


@pytest.mark.parametrize("name", EVERY)
def test_closing_twice_is_once(name):
    one = begun(name)
    one.env.close()
    one.env.close()


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"disturbance": "wimd"}, "disturbance='wimd' is not known"),
        ({"disturbance": 3}, "disturbance=3 is not known"),
        ({"disturbance": {"kind": "gust"}}, "disturbance=.* is not known"),
        ({"disturbance": np.zeros(2)}, "disturbance=.* is not known"),
        ({"disturbance_bound": "0.3"}, "disturbance_bound='0.3'"),
        ({"disturbance_bound": math.nan}, "disturbance_bound=nan"),
        ({"disturbance_bound": 1e300}, r"disturbance_bound=1e\+300 must be .* at most 1e\+06"),
        ({"disturbance_channels": "some"}, "disturbance_channels='some'"),
        ({"disturbance_channels": ["no"] * 4}, "disturbance_channels=.* booleans"),
        ({"disturbance_channels": [[True]]}, "disturbance_channels=.* booleans"),
        ({"disturbance_channels": 3}, "disturbance_channels=3"),
        ({"disturbance": "worst", "metric": "M"}, "metric='M' must be a symmetric positive"),
        ({"disturbance": "worst", "metric": np.eye(3)}, "metric=.* of shape"),
        ({"disturbance": "worst", "metric": -np.eye(4)}, "metric=.* positive definite"),
        ({"disturbance": "worst", "metric": np.full((4, 4), np.nan)}, "metric="),
    ],
)
@pytest.mark.parametrize("name", PLAIN)
def test_arguments_that_make_no_sense_are_refused_by_name(name, change, match):
    with pytest.raises(ValueError, match=match):
        player(name, **change)


WITH_COMPILED = [name for name in PLAIN if EVERY[name].cartpole or name in VECTOR]


@pytest.mark.parametrize("value", ["false", "", 1, 0.0, [1], np.zeros(2)])
@pytest.mark.parametrize("name", WITH_COMPILED)
def test_whether_to_compile_is_true_or_false(name, value):
    kind = type(bare(player(name).env))
    with pytest.raises(ValueError, match=r"compiled=.* must be True or False"):
        kind(compiled=value)


@pytest.mark.parametrize("value", [2.0, True, "2", 0, -2, np.zeros(2)])
@pytest.mark.parametrize("name", [CARTPOLE, SPACECRAFT])
def test_worlds_are_counted_in_whole_numbers(name, value):
    with pytest.raises(ValueError, match=r"num_envs=.* must be a whole number"):
        gym.make_vec(name, num_envs=value)


@pytest.mark.parametrize("value", ["same step", None, 3, [1], np.zeros(2)])
@pytest.mark.parametrize("name", [CARTPOLE, SPACECRAFT])
def test_a_mode_of_autoreset_is_known_or_refused(name, value):
    with pytest.raises(ValueError, match=r"autoreset_mode=.* must be one of next_step, same_step"):
        gym.make_vec(name, num_envs=2, autoreset_mode=value)

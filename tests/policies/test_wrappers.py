"""Which wrappers a policy is built through: every one of the libraries around us is judged."""

import inspect
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import vector as vector_wrappers
from pettingzoo.utils import conversions
from pettingzoo.utils import wrappers as zoo
from stable_baselines3.common import vec_env as sb3
from stable_baselines3.common.monitor import Monitor

from lagros_benchmarks.training.sb3_parallel import ParallelVecEnv
from lagros_benchmarks.training.sb3_vector import SB3VectorEnv
from lagros_envs import spacecraft_v0
from lagros_envs.tasks.cartpole.env import CartPoleEnv
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_policies import make
from lagros_policies.wrappers import HARMLESS, what_it_changes

BOX = spaces.Box(-1.0, 1.0, (13,), np.float32)
WIDE = spaces.Box(-np.inf, np.inf, (13,), np.float32)


def same(value):
    return value


def twice(value):
    return 2.0 * value


# How each wrapper of `gymnasium.wrappers` is put on, by whether a policy is built through it.
LOOKED_THROUGH: dict[str, Any] = {
    "AddWhiteNoise": lambda env: gym.wrappers.AddWhiteNoise(env, 0.5),
    "Autoreset": gym.wrappers.Autoreset,
    "ClipReward": lambda env: gym.wrappers.ClipReward(env, -1.0, 1.0),
    "FlattenObservation": gym.wrappers.FlattenObservation,
    "HumanRendering": gym.wrappers.HumanRendering,
    "NormalizeReward": gym.wrappers.NormalizeReward,
    "ObstructView": lambda env: gym.wrappers.ObstructView(env, 0.5, 3),
    "OrderEnforcing": gym.wrappers.OrderEnforcing,
    "PassiveEnvChecker": gym.wrappers.PassiveEnvChecker,
    "RecordEpisodeStatistics": gym.wrappers.RecordEpisodeStatistics,
    "RenderCollection": gym.wrappers.RenderCollection,
    "TimeLimit": lambda env: gym.wrappers.TimeLimit(env, 10),
    "TransformReward": lambda env: gym.wrappers.TransformReward(env, twice),
}
REFUSED: dict[str, Any] = {
    "ClipAction": gym.wrappers.ClipAction,
    "DelayObservation": lambda env: gym.wrappers.DelayObservation(env, 1),
    "FrameStackObservation": lambda env: gym.wrappers.FrameStackObservation(env, 2),
    "MaxAndSkipObservation": gym.wrappers.MaxAndSkipObservation,
    "NormalizeObservation": gym.wrappers.NormalizeObservation,
    "RepeatAction": lambda env: gym.wrappers.RepeatAction(env, 2),
    "RescaleAction": lambda env: gym.wrappers.RescaleAction(env, np.float32(-2.0), np.float32(2.0)),
    "ReshapeObservation": lambda env: gym.wrappers.ReshapeObservation(env, (13, 1)),
    "StickyAction": lambda env: gym.wrappers.StickyAction(env, 0.5),
    "TransformAction": lambda env: gym.wrappers.TransformAction(env, same, env.action_space),
    "TransformObservation": lambda env: gym.wrappers.TransformObservation(
        env, same, env.observation_space
    ),
}
# Judged by their classes alone: they need another library, files, pictures or a bounded space.
BY_CLASS = {
    "AddRenderObservation": False,
    "ArrayConversion": False,
    "AtariPreprocessing": False,
    "DiscretizeAction": False,
    "DiscretizeObservation": False,
    "DtypeObservation": False,
    "FilterObservation": False,
    "GrayscaleObservation": False,
    "JaxToNumpy": False,
    "JaxToTorch": False,
    "NumpyToTorch": False,
    "RecordVideo": True,
    "RescaleObservation": False,
    "ResizeObservation": False,
    "TimeAwareObservation": False,
}
VECTOR_LOOKED_THROUGH: dict[str, Any] = {
    "ClipReward": lambda env: vector_wrappers.ClipReward(env, -1.0, 1.0),
    "DictInfoToList": vector_wrappers.DictInfoToList,
    "FlattenObservation": vector_wrappers.FlattenObservation,
    "NormalizeReward": vector_wrappers.NormalizeReward,
    "RecordEpisodeStatistics": vector_wrappers.RecordEpisodeStatistics,
    "TransformReward": lambda env: vector_wrappers.TransformReward(env, twice),
    "VectorizeTransformReward": lambda env: vector_wrappers.VectorizeTransformReward(
        env, gym.wrappers.TransformReward, func=twice
    ),
}
VECTOR_REFUSED: dict[str, Any] = {
    "ClipAction": vector_wrappers.ClipAction,
    "NormalizeObservation": vector_wrappers.NormalizeObservation,
    "RescaleAction": lambda env: vector_wrappers.RescaleAction(
        env, np.float32(-2.0), np.float32(2.0)
    ),
    "TransformAction": lambda env: vector_wrappers.TransformAction(env, same),
    "TransformObservation": lambda env: vector_wrappers.TransformObservation(env, same),
}
VECTOR_BY_CLASS = {
    "ArrayConversion": False,
    "DtypeObservation": False,
    "FilterObservation": False,
    "GrayscaleObservation": False,
    "HumanRendering": True,
    "JaxToNumpy": False,
    "JaxToTorch": False,
    "NumpyToTorch": False,
    "RecordVideo": True,
    "RescaleObservation": False,
    "ReshapeObservation": False,
    "ResizeObservation": False,
    "VectorizeTransformAction": False,
    "VectorizeTransformObservation": False,
}


def cartpole(**settings):
    return CartPoleEnv(disturbance="uniform", render_mode="rgb_array", **settings)


def vector(**settings):
    return gym.make_vec("lagros/CartPole-v0", num_envs=2, disturbance="uniform", **settings)


def test_every_wrapper_of_gymnasium_is_judged():
    judged = {*LOOKED_THROUGH, *REFUSED, *BY_CLASS}
    assert judged == set(gym.wrappers.__all__) - {"vector"}
    assert {*VECTOR_LOOKED_THROUGH, *VECTOR_REFUSED, *VECTOR_BY_CLASS} == set(
        vector_wrappers.__all__
    )


@pytest.mark.parametrize("name", LOOKED_THROUGH)
def test_looks_through_a_wrapper_that_changes_nothing(name):
    env, bare = LOOKED_THROUGH[name](cartpole()), cartpole()
    policy = make("lqr", env)
    # What it shows and does is what the environment shows and does.
    seen, _ = env.reset(seed=3)
    expected, _ = bare.reset(seed=3)
    for _ in range(4):
        assert np.array_equal(seen, expected)
        action, _ = policy.predict(seen)
        seen, *_ = env.step(3.0 * action)
        expected, *_ = bare.step(3.0 * action)
    env.close()


@pytest.mark.parametrize("name", REFUSED)
def test_refuses_a_wrapper_that_may_change_what_is_seen_or_done(name):
    env = REFUSED[name](cartpole())
    for around in (env, gym.wrappers.TimeLimit(env, 10)):
        with pytest.raises(ValueError, match=rf"^{name} .*allow_wrappers=True"):
            make("lqr", around)
    assert make("lqr", env, allow_wrappers=True).name == "lqr"


@pytest.mark.parametrize("name", VECTOR_LOOKED_THROUGH)
def test_looks_through_a_vector_wrapper_that_changes_nothing(name):
    env, bare = VECTOR_LOOKED_THROUGH[name](vector()), vector()
    policy = make("lqr", env)
    seen, _ = env.reset(seed=3)
    expected, _ = bare.reset(seed=3)
    for _ in range(4):
        assert np.array_equal(seen, expected)
        action, _ = policy.predict(seen)
        seen, *_ = env.step(3.0 * action)
        expected, *_ = bare.step(3.0 * action)
    env.close()


@pytest.mark.parametrize("name", VECTOR_REFUSED)
def test_refuses_a_vector_wrapper_that_may_change_what_is_seen_or_done(name):
    env = VECTOR_REFUSED[name](vector())
    with pytest.raises(ValueError, match=rf"^{name} .*allow_wrappers=True"):
        make("lqr", env)
    env.close()


@pytest.mark.parametrize(
    ("module", "name", "fits"),
    [(gym.wrappers, name, fits) for name, fits in BY_CLASS.items()]
    + [(vector_wrappers, name, fits) for name, fits in VECTOR_BY_CLASS.items()],
)
def test_judges_by_the_class(module, name, fits):
    try:
        kind = getattr(module, name)
    except ImportError:
        pytest.skip("its library is not installed")
    assert (what_it_changes(kind) is None) == fits


# Not judged: wrappers of environments with discrete actions, and functions.
ZOO = {
    "AssertOutOfBoundsWrapper": False,
    "BaseParallelWrapper": True,
    "BaseWrapper": True,
    "CaptureStdoutWrapper": True,
    "ClipOutOfBoundsWrapper": False,
    "MultiEpisodeEnv": True,
    "MultiEpisodeParallelEnv": True,
    "OrderEnforcingWrapper": True,
    "RecordVideo": True,
    "RecordVideoParallel": True,
    "TerminateIllegalWrapper": False,
    "aec_to_parallel_wrapper": True,
    "parallel_to_aec_wrapper": True,
    "turn_based_aec_to_parallel_wrapper": False,
}


def test_every_wrapper_of_pettingzoo_is_judged():
    found = {name for name, kind in vars(zoo).items() if inspect.isclass(kind)}
    found |= {name for name in vars(conversions) if name.endswith("_wrapper")}
    # Versions differ in their recorders.
    assert found <= set(ZOO)


@pytest.mark.parametrize("name", ZOO)
def test_judges_the_wrappers_of_pettingzoo(name):
    kind: Any = getattr(zoo, name, None) or getattr(conversions, name, None)
    if kind is None:
        pytest.skip("this version of PettingZoo has no such wrapper")
    assert (what_it_changes(kind) is None) == ZOO[name]


def test_refuses_a_wrapper_of_pettingzoo():
    env = zoo.ClipOutOfBoundsWrapper(spacecraft_v0.env(num_agents=2))
    with pytest.raises(ValueError, match=r"^ClipOutOfBoundsWrapper "):
        make("ppo", env)
    assert make("ppo", zoo.BaseParallelWrapper(spacecraft_v0.parallel_env(2))).name == "ppo"


def test_takes_the_forms_of_the_spacecraft():
    forms: list[Any] = [
        spacecraft_v0.parallel_env(3),
        spacecraft_v0.env(num_agents=3),
        conversions.aec_to_parallel(spacecraft_v0.env(num_agents=3)),
        ParallelVecEnv([spacecraft_v0.parallel_env(3)] * 2),
        gym.make_vec("lagros/Spacecraft-v0", num_envs=6, num_agents=3),
    ]
    for env in forms:
        policy: Any = make("tube-mpc", env)
        assert policy.preset.agents == 3


SB3 = {
    "VecCheckNan": True,
    "VecExtractDictObs": False,
    "VecFrameStack": False,
    "VecMonitor": True,
    "VecNormalize": False,
    "VecTransposeImage": False,
    "VecVideoRecorder": True,
}


def test_every_wrapper_of_stable_baselines3_is_judged():
    kinds = {name: kind for name, kind in vars(sb3).items() if inspect.isclass(kind)}
    wrappers = {
        name
        for name, kind in kinds.items()
        if issubclass(kind, sb3.VecEnvWrapper) and kind is not sb3.VecEnvWrapper
    }
    assert wrappers == set(SB3)


@pytest.mark.parametrize("name", SB3)
def test_judges_the_wrappers_of_stable_baselines3(name):
    assert (what_it_changes(getattr(sb3, name)) is None) == SB3[name]


def test_takes_our_own_vectors_of_stable_baselines3():
    env = SB3VectorEnv(vector(autoreset_mode="same_step"))
    assert make("lqr", sb3.VecCheckNan(env)).name == "lqr"
    assert make("lqr", sb3.DummyVecEnv([lambda: Monitor(cartpole())])).name == "lqr"
    with pytest.raises(ValueError, match=r"^VecNormalize "):
        make("lqr", sb3.VecNormalize(env))


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_looks_into_the_environments_of_a_vector(mode):
    plain = gym.make_vec("lagros/CartPole-v0", num_envs=2, vectorization_mode=mode)
    assert make("lqr", plain).name == "lqr"
    plain.close()
    wrapped = gym.make_vec(
        "lagros/CartPole-v0",
        num_envs=2,
        vectorization_mode=mode,
        wrappers=[gym.wrappers.NormalizeObservation],
    )
    with pytest.raises(ValueError, match=r"^NormalizeObservation "):
        make("lqr", wrapped)
    wrapped.close()


def test_environments_of_a_vector_must_be_alike():
    settings = iter([CartPoleSettings(), CartPoleSettings(effort_weight=0.5)])
    vectors = gym.vector.SyncVectorEnv([lambda: cartpole(settings=next(settings))] * 2)
    with pytest.raises(ValueError, match="0 and 1 of SyncVectorEnv differ in their settings"):
        make("lqr", vectors)
    bounds = iter([0.1, 0.9])
    vectors = gym.vector.SyncVectorEnv([lambda: cartpole(disturbance_bound=next(bounds))] * 2)
    with pytest.raises(ValueError, match="0 and 1 of SyncVectorEnv differ in their disturbance_b"):
        make("lqr", vectors)


class Counting(gym.Wrapper[Any, Any, Any, Any]):
    """A wrapper of a user's that only adds a method."""

    def count(self) -> int:
        return 1


class Logging(gym.Wrapper[Any, Any, Any, Any]):
    """A wrapper that overrides step; whether it changes something cannot be seen."""

    def step(self, action: Any) -> Any:
        return super().step(action)


class Punishing(gym.RewardWrapper[Any, Any]):
    """A wrapper of the reward."""

    def reward(self, reward: Any) -> float:
        return float(reward) - 1.0


class Widened(gym.Wrapper[Any, Any, Any, Any]):
    """A wrapper that only says that the space is another one."""

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.observation_space = WIDE if env.observation_space != WIDE else BOX


class Statistics(gym.wrappers.RecordEpisodeStatistics[Any, Any]):
    """A harmless wrapper made harmful."""

    def reset(self, **arguments: Any) -> Any:
        observation, info = super().reset(**arguments)
        return 0.0 * observation, info


class Twice(CartPoleEnv):
    """An environment of a user's with another meaning of the observation."""

    def _observation(self) -> Any:
        return 2.0 * super()._observation()


class Named(CartPoleEnv):
    """An environment of a user's that means the same."""

    title = "mine"


@pytest.mark.parametrize("kind", [Counting, Punishing])
def test_looks_through_a_users_wrapper_that_overrides_nothing_that_matters(kind):
    assert make("lqr", kind(cartpole())).name == "lqr"


@pytest.mark.parametrize(
    ("kind", "what"),
    [
        (Logging, "overrides step"),
        (Widened, "has another observation_space"),
        (Statistics, "overrides reset"),
    ],
)
def test_refuses_a_users_wrapper_unless_it_is_allowed(kind, what):
    env = kind(cartpole())
    with pytest.raises(ValueError, match=f"^{kind.__name__} {what}"):
        make("lqr", env)
    assert make("lqr", env, allow_wrappers=True).name == "lqr"


def test_judges_a_users_subclass_of_the_environment():
    assert make("lqr", Named()).name == "lqr"
    with pytest.raises(ValueError, match=r"^Twice overrides _observation"):
        make("lqr", Twice())


class Answering(gym.Wrapper[Any, Any, Any, Any]):
    """A wrapper that answers in place of its methods."""

    def __getattribute__(self, name: str) -> Any:
        return object.__getattribute__(self, name)


@pytest.mark.parametrize("depth", ["wrapper", "environment"])
@pytest.mark.parametrize("name", ["step", "reset"])
def test_refuses_what_has_a_method_replaced(depth, name):
    env = cartpole()
    changed = env if depth == "wrapper" else env.unwrapped
    original = getattr(changed, name)
    setattr(changed, name, lambda *given, **named: original(*given, **named))
    with pytest.raises(ValueError, match=f"^{type(changed).__name__} has {name} replaced"):
        make("lqr", env)
    assert make("lqr", env, allow_wrappers=True).name == "lqr"
    with pytest.raises(ValueError, match=r"^Answering overrides __getattribute__"):
        make("lqr", Answering(cartpole()))


def test_an_id_or_a_spec_makes_the_environment():
    assert make("lqr", "lagros/CartPole-v0").name == "lqr"
    assert make("ppo", gym.spec("lagros/Spacecraft-v0")).name == "ppo"
    for name in ("lagros/CartPoll-v0", "cartpole", "", "x:y/z"):
        with pytest.raises(ValueError, match="lagros/CartPole-v0"):
            make("lqr", name)


@pytest.mark.parametrize("thing", [None, 3, CartPoleEnv, spacecraft_v0, object(), [CartPoleEnv()]])
def test_what_is_no_environment_is_refused(thing):
    with pytest.raises(TypeError, match="use an environment of lagros_envs"):
        make("lqr", thing)


def test_the_list_names_only_what_there_is():
    # Recorders came and went between the versions; the rest must exist.
    for name in HARMLESS["gymnasium"]:
        assert any(
            hasattr(place, name) for place in (gym, gym.vector, gym.wrappers, vector_wrappers)
        ), name


def test_looks_through_the_collector_of_minari():
    minari = pytest.importorskip("minari")
    assert what_it_changes(minari.DataCollector) is None

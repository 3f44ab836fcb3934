"""What a policy is, and the names under which the policies are built."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable
from typing import Any, ClassVar, Literal, Protocol, TypeVar, cast, runtime_checkable

import numpy as np

from lagros_envs.aliases import moved_names
from lagros_envs.arrays import BoolArray, Float32Array
from lagros_envs.checks import check_flag, shown, suggestion
from lagros_envs.task import Described, Task
from lagros_policies.naming import UserClass, model_file, user_class
from lagros_policies.room import imported, named_in
from lagros_policies.wrappers import bare_environment

# What a planner remembers between calls; stateless policies keep None.
PolicyState = Any
Observes = Literal["local", "global"]

_INTERFACE = "predict(observation, state=None, episode_start=None, deterministic=True)"
# What an object may have beside `predict`.
_OPTIONAL = ("name", "observes", "reseed", "counters", "bare_forward", "example_features")

# Policies of every task of one body; each is imported when it is asked for, as torch, solvers and
# learned weights are needed only then.
_SINGLE = {
    "learned": "lagros_policies.learned:LearnedPolicy",
    "learned-mpc": "lagros_policies.learned:LearnedMpcPolicy",
    "tube-mpc": "lagros_policies.tube_mpc:TubeMpcPolicy",
    "tube-mpc:replan": "lagros_policies.tube_mpc:ReplanningTubeMpcPolicy",
    "lagros": "lagros_policies.lagros:LagrosPolicy",
    "mpc": "lagros_policies.mpc:MpcPolicy",
    "lqr": "lagros_policies.baselines:LqrPolicy",
    "sd-lqr": "lagros_policies.sd_lqr:SdLqrPolicy",
    "random": "lagros_policies.baselines:RandomPolicy",
    "c3m": "lagros_policies.c3m:C3mPolicy",
    "ppo": "lagros_policies.actor:PpoPolicy",
    "sac": "lagros_policies.actor:SacPolicy",
    "td3": "lagros_policies.actor:Td3Policy",
    "residual": "lagros_policies.residual:ResidualPolicy",
}
# Other laws around the plan of "tube-mpc", to be held against the shipped one.
_LAWS = "gain", "projected", "half-rate", "double-rate", "no-rate", "least-norm", "tuned"
_OTHER_LAWS = {**{f"tube-mpc:{law}": law for law in _LAWS}, "lqr-plan": "lqr"}
_SINGLE |= dict.fromkeys(_OTHER_LAWS, _SINGLE["tube-mpc"])
NAMES = tuple(_SINGLE)
moved_names(__name__)


@runtime_checkable
class Policy(Protocol):
    """What a policy of anybody's has: stable-baselines3's `PolicyPredictor`, a name, its input."""

    name: str
    observes: Observes

    def predict(
        self,
        observation: Float32Array,
        state: PolicyState = None,
        episode_start: BoolArray | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, PolicyState]:
        """Choose an action.

        Args:
            observation: Flat observation (o,), or a batch of them (B, o).
            state: What the last call returned; None at the start of an episode.
            episode_start: Which rows of a batch start an episode, shape (B,).
            deterministic: Whether to suppress the policy's own randomness.

        Returns:
            The action (m,) or (B, m), float32 in the units of the environment, and the state.
        """


class BasePolicy:
    """All that is asked of a policy, answered as by one that has nothing but `predict`.

    Attributes:
        name: Name in tables.
        observes: "local" for the rows that the environment returns; "global" for the `state()` of
            a world of many agents.
        prepared: Whether it is built with the bound of the disturbance, as `disturbance_bound`.
        restricted: Whether it is told if other settings are allowed, as `allow_other_settings`.
        recorded_as: The policy that a file of weights must name to be flown by it; None for any.
        planner: What it plans with; None where it does not plan.
        tracking: The law by which it follows a plan, where its error has a certified bound.
    """

    name: str = "policy"
    observes: Observes = "local"
    prepared: ClassVar[bool] = False
    restricted: ClassVar[bool] = False
    recorded_as: str | None = None
    planner: Any = None
    tracking: Any = None

    def predict(
        self,
        observation: Float32Array,
        state: PolicyState = None,
        episode_start: BoolArray | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, PolicyState]:
        """Choose an action; see `Policy.predict`."""
        raise NotImplementedError(f"{type(self).__name__} needs {_INTERFACE}")

    def counters(self, state: PolicyState) -> dict[str, int]:
        """Return what the policy has counted in its memory of an episode, or of several."""
        return {}

    def reseed(self, generator: np.random.Generator) -> None:
        """Take the generator of an episode, from which the policy is to draw."""

    @property
    def draws(self) -> bool:
        """Whether it takes a generator, so that episodes in one batch would share it."""
        return type(self).reseed is not BasePolicy.reseed

    @property
    def bare(self) -> BasePolicy:
        """The policy without the safety filter that it uses."""
        return self

    def example_features(self) -> Any:
        """Return an input of the network, to time it alone; None for a policy that has none."""
        return None

    def bare_forward(self, features: Any) -> Any:
        """Evaluate the network alone, for timing."""
        raise NotImplementedError(f"{self.name} has no network to evaluate alone")


class AdaptedPolicy(BasePolicy):
    """An object with `predict`, and with whatever else of `BasePolicy` it has.

    Args:
        inner: The object.
        name: Name in tables, if it has none itself.

    Attributes:
        inner: The object.
    """

    def __init__(self, inner: Any, name: str | None = None) -> None:
        """Look at what the object has; what its properties raise is raised here."""
        found = {part: getattr(inner, part, None) for part in _OPTIONAL}
        self.inner = inner
        self.name = str(found["name"] or name or type(inner).__name__)
        self.observes = found["observes"] or "local"
        self._has = frozenset(part for part, value in found.items() if callable(value))

    def predict(
        self,
        observation: Float32Array,
        state: PolicyState = None,
        episode_start: BoolArray | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, PolicyState]:
        """Ask the object; see `Policy.predict`."""
        answer: tuple[Float32Array, PolicyState] = self.inner.predict(
            observation, state, episode_start, deterministic
        )
        return answer

    def counters(self, state: PolicyState) -> dict[str, int]:
        """Return what the object counts."""
        return self.inner.counters(state) if "counters" in self._has else {}

    def reseed(self, generator: np.random.Generator) -> None:
        """Pass the generator on, if the object takes one."""
        if self.draws:
            self.inner.reseed(generator)

    @property
    def draws(self) -> bool:
        """Whether the object takes a generator."""
        return "reseed" in self._has

    def example_features(self) -> Any:
        """Return an input of the object's network; None if it has none to be timed."""
        timed = {"example_features", "bare_forward"} <= self._has
        return self.inner.example_features() if timed else None

    def bare_forward(self, features: Any) -> Any:
        """Evaluate the object's network alone."""
        return self.inner.bare_forward(features)


def as_policy(given: Any, name: str | None = None) -> BasePolicy:
    """Return an object as a policy of which everything can be asked.

    Args:
        given: A policy of this package, or any object with `predict`, such as a model of
            stable-baselines3.
        name: Name in tables, for an object that has none.

    Returns:
        The object itself if it is a `BasePolicy`.

    Raises:
        TypeError: It has no `predict` that can be called as it must be.
        ValueError: It says wrongly what it observes.
    """
    what = f"policy {name!r}" if name else "the policy"
    if inspect.isclass(given):
        raise TypeError(f"{what} is the class {given.__name__}; it must be an object of it")
    predict = getattr(given, "predict", None)
    if not callable(predict):
        raise TypeError(f"{what} cannot fly: a {type(given).__name__} has no method {_INTERFACE}")
    try:
        signature = inspect.signature(predict)
    except (TypeError, ValueError):
        pass  # written in C, it does not tell
    else:
        try:
            signature.bind(None, None, None, True)
        except TypeError as error:
            raise TypeError(
                f"{what} cannot fly: predict{signature} {error}; it must be {_INTERFACE}"
            ) from None
    policy = given if isinstance(given, BasePolicy) else AdaptedPolicy(given, name)
    if policy.observes not in ("local", "global"):
        raise ValueError(f'{what} has observes={policy.observes!r}; it must be "local" or "global"')
    return policy


Memory = TypeVar("Memory")


def row_memories(
    state: PolicyState,
    episode_start: BoolArray | None,
    count: int,
    rows: str,
    kind: type[Memory],
) -> list[Memory | None]:
    """Return what is remembered of each row of an observation, None where its episode starts.

    Args:
        state: What `Policy.predict` returned last: one memory per row; None if it is new.
        episode_start: Which rows start an episode, shape (count,); None if none does.
        count: Number of rows observed.
        rows: What a row is, in the plural, for the message.
        kind: Of the memories.

    Raises:
        ValueError: Memories, starts and rows are not equally many, or the memories are another
            policy's.
    """
    memories = [None] * count if state is None else state
    if not isinstance(memories, list | tuple) or not all(
        memory is None or isinstance(memory, kind) for memory in memories
    ):
        raise ValueError(
            f"state must be what predict returned last, a {kind.__name__} for each of the {rows}, "
            "or None at the start of an episode"
        )
    starts = np.zeros(count, bool) if episode_start is None else np.ravel(episode_start)
    if starts.dtype.kind not in "biuf":
        raise ValueError(f"episode_start={shown(episode_start)} must be True or False for each row")
    if len(memories) != count or len(starts) != count:
        raise ValueError(
            f"state remembers {len(memories)} {rows} and episode_start is for {len(starts)}; "
            f"{count} are observed"
        )
    return [None if start else memory for memory, start in zip(memories, starts, strict=True)]


def policy_names(task: Described) -> tuple[str, ...]:
    """Return the names of the policies of a task."""
    return tuple(_places(task))


def _places(task: Described) -> dict[str, str]:
    """Return where the policies of a task are, by name."""
    return {**(_SINGLE if isinstance(task, Task) else {}), **named_in(task, "POLICIES", {})}


def make(
    name: str | Callable[..., Policy],
    env: Any,
    allow_wrappers: bool = False,
    allow_other_settings: bool = False,
    **settings: Any,
) -> Policy:
    """Build a policy for an environment.

    A policy speaks the environment's own observations and actions, so that one within wrappers that
    may change their meaning is refused; those that record, limit or render are looked through. What
    was trained or designed flies the settings for which it was, as its file says; the paper's where
    the file says nothing.

    Args:
        name: One of `policy_names(task)`; the path of a stable-baselines3 model (`ppo.zip`,
            `sac:model.zip`); `module:Class`, a class of your own that is built with the task's
            settings (and, where its attribute `prepared` is True, with the bound of the disturbance
            as `disturbance_bound`); or such a class itself. A zip of stable-baselines3 holds
            pickled code and a module is code: both run, so name only what you trust.
        env: A Gymnasium or PettingZoo environment of this package, several in a vector, or the id
            of one; the policy takes its task settings (and preset, and the bound of its
            disturbance) and nothing else.
        allow_wrappers: Look through every wrapper, as one of your own that changes neither.
        allow_other_settings: Fly other settings too. Nothing that is said of the policy holds then.
        settings: Passed to the policy, e.g. `weights=path` or `metric=...`.

    Returns:
        The policy. What a class of your own builds is returned as it is; see `as_policy`.

    Raises:
        ValueError: The name or the id is unknown, the settings or the preset are others than those
            of the environment, or a wrapper may change what an observation or
            an action means, or the weights are another policy's or were made for other settings.
        FileNotFoundError: The weights have not been made.
        TypeError: The environment is not one of this package.
        ImportError: A package that the policy needs is not installed.
    """
    check_flag("allow_wrappers", allow_wrappers)
    check_flag("allow_other_settings", allow_other_settings)
    world = bare_environment(env, allow_wrappers)
    if not (isinstance(name, str) or callable(name)):
        raise ValueError(f"name={shown(name)} must be text: a name, a path or module:Class")
    if "settings" in settings:
        raise _of_the_environment("settings")
    task = world.settings
    classes = _places(task)
    told = named_in(task, "told", None)
    if told is not None:
        settings = told(world, settings)
    if not isinstance(name, str):
        return _built(name, world, allow_other_settings, settings)
    if name in classes:
        if task.most_agents == 1 and name in _OTHER_LAWS:
            settings = {"law": _OTHER_LAWS[name], **settings}
        return _shipped(name, classes[name], world, allow_other_settings, settings)
    model = model_file(name)
    if model is not None:
        from lagros_policies.sb3_model import load_stable_baselines3

        return load_stable_baselines3(model.path, model.algorithm, task, **settings)
    own = None if name.partition(":")[0] in classes else user_class(name)
    if own is not None:
        return _built(_class_named(name, own), world, allow_other_settings, settings)
    raise ValueError(
        f"policy {shown(name)} is not known.{suggestion(name, classes)} Use one of "
        f"{', '.join(classes)}, the path of a stable-baselines3 zip, or module:Class"
    )


def _of_the_environment(what: str) -> ValueError:
    return ValueError(
        f"{what}: a policy takes those of the environment; make the environment with them, or "
        "build the class of the policy yourself"
    )


def _built(
    policy: Callable[..., Policy],
    world: Any,
    allow_other_settings: bool,
    settings: dict[str, Any],
) -> Policy:
    if getattr(policy, "prepared", False):
        settings = {"disturbance_bound": world.disturbance.bound, **settings}
    if getattr(policy, "restricted", False):
        settings = {"allow_other_settings": allow_other_settings, **settings}
    return policy(world.settings, **settings)


def _shipped(
    name: str, place: str, world: Any, allow_other_settings: bool, settings: dict[str, Any]
) -> Policy:
    try:
        return _built(imported(place), world, allow_other_settings, settings)
    except ModuleNotFoundError as error:
        raise ImportError(
            f"policy {name!r} needs {error.name}, which is not installed: "
            "pip install 'lagros[policies]'"
        ) from error


def _class_named(name: str, own: UserClass) -> Callable[..., Policy]:
    try:
        module = importlib.import_module(own.module)
    except ImportError as error:
        raise ValueError(
            f"policy {name!r}: {error}; module:Class must name a class that Python can import from "
            "here"
        ) from error
    found = getattr(module, own.attribute, None)
    if not callable(found):
        place = getattr(module, "__file__", None) or "built into Python"
        raise ValueError(f"policy {name!r}: {own.module} ({place}) has no class {own.attribute!r}")
    return cast("Callable[..., Policy]", found)

"""Every field of every class of settings: a value of another type is refused by the field's name.

A new class of settings is found by itself, here, if its name says so or it checks its fields.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import math
import pkgutil
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
import pytest

import lagros_benchmarks
import lagros_envs
import lagros_policies

NO_NUMBERS = ("0.5", "", "x", True, [1.0], {}, 1j, 10**400, object(), np.ones(2))
BAD: dict[Any, tuple[Any, ...]] = {
    float: (*NO_NUMBERS, None, math.nan, math.inf, -math.inf),
    int: (*NO_NUMBERS, None, 1.5, 2.0, math.nan, math.inf, np.float64(3.0)),
    bool: (0, 1, "yes", "", None, [], 0.0),
    str: (1, None, b"x", ["x"], ("x",), 0.5, True, {}),
}


def modules() -> Iterator[types.ModuleType]:
    for package in (lagros_envs, lagros_policies, lagros_benchmarks):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not found.name.endswith("__main__"):
                yield importlib.import_module(found.name)


def settings() -> Iterator[type]:
    """Yield every dataclass that holds settings and can be built from its defaults."""
    for module in modules():
        for kind in vars(module).values():
            if not (inspect.isclass(kind) and dataclasses.is_dataclass(kind)):
                continue
            if kind.__module__ != module.__name__ or not all(map(has_default, fields(kind))):
                continue
            if kind.__name__.endswith("Settings") or checks_fields(kind):
                yield kind


def checks_fields(kind: type) -> bool:
    ours = (base for base in kind.__mro__ if base.__module__.startswith("lagros"))
    calls = ("check_fields(", "check_constants(")
    return any(call in inspect.getsource(base) for base in ours for call in calls)


def fields(kind: type) -> tuple[Any, ...]:
    return tuple(field for field in dataclasses.fields(kind) if field.init)


def has_default(field: dataclasses.Field[Any]) -> bool:
    missing = dataclasses.MISSING
    return field.default is not missing or field.default_factory is not missing


def bad_values(hint: Any) -> tuple[Any, ...]:
    """Return values that an annotation rules out; none where it says too little."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        options = [bad_values(part) for part in parts if part is not types.NoneType]
        if len(options) != 1:
            return ()
        return tuple(value for value in options[0] if value is not None)
    if origin is tuple:
        bad = bad_values(parts[0])
        return ("", "abc", 1, None, *((value,) for value in bad), *([value] for value in bad[:2]))
    if origin is Literal:
        return ("", "nonsense", 1.5, None, [])
    if hint is Path:
        return (1, 0.5, b"x", ["x"])
    if dataclasses.is_dataclass(hint):
        return ("", 1, None, {}, [])
    return BAD.get(hint, ())


KINDS = sorted(settings(), key=lambda kind: f"{kind.__module__}.{kind.__name__}")


def test_the_settings_that_users_give_are_among_them():
    names = {kind.__name__ for kind in KINDS}
    assert names >= {
        "BenchmarkSettings",
        "AttackSettings",
        "SearchSettings",
        "WatchSettings",
        "ReproduceSettings",
        "SpacecraftReproduceSettings",
        "DemonstrationSettings",
        "CartPoleTraining",
        "SpacecraftTraining",
        "Ppo",
        "Sac",
        "Td3",
        "Preset",
        "CartPoleSettings",
        "SpacecraftSettings",
        "PaperTube",
        "CartPole",
        "Spacecraft",
        "Backend",
    }


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_a_value_of_another_type_is_refused_by_the_fields_name_in_one_line(kind):
    kind()
    hints = get_type_hints(kind)
    tried = 0
    for field in fields(kind):
        for value in bad_values(hints[field.name]):
            tried += 1
            with pytest.raises(ValueError, match=r"^.+$") as error:
                kind(**{field.name: value})
            text = str(error.value)
            shown = f"{kind.__name__}.{field.name}: {text[:200]}"
            assert field.name.removesuffix("s") in text.replace(" ", "_"), shown
            assert "\n" not in text, shown
            assert len(text) < 500, shown
    assert tried


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_numbers_of_numpy_pass_and_settings_can_be_changed_by_replace(kind):
    built = kind()
    changes: dict[str, Any] = {}
    for field in fields(kind):
        value = getattr(built, field.name)
        if type(value) is float:
            changes[field.name] = np.float64(value)
        elif type(value) is int:
            changes[field.name] = np.int64(value)
    assert dataclasses.replace(built, **changes) == built


@pytest.mark.parametrize(
    ("name", "most"),
    [("episodes", 10**12), ("jobs", 10**6), ("chunk", 10**12), ("timing_episodes", 10**12)],
)
def test_counts_that_no_machine_holds_are_refused(name, most):
    from lagros_benchmarks.run.settings import BenchmarkSettings

    with pytest.raises(ValueError, match=f"{name}={most} must be a whole number, 1 to"):
        BenchmarkSettings(**{name: most})


@pytest.mark.parametrize("given", [None, [], "lqr", {"lqr": 5}, {"lqr": {1: 2}}, {"lqr": None}])
def test_settings_of_policies_are_mappings(given):
    from lagros_benchmarks.run.settings import BenchmarkSettings

    with pytest.raises(ValueError, match=r"^policy_settings=.+ must be mappings"):
        BenchmarkSettings(policies=("lqr",), policy_settings=given)


@pytest.mark.parametrize("count", [10**4, 10**6, 10**12])
def test_worlds_of_more_agents_than_memory_holds_are_refused(count):
    from lagros_benchmarks.run.settings import BenchmarkSettings
    from lagros_envs.tasks.spacecraft.scenarios import preset_named

    with pytest.raises(ValueError, match=f"agents={count} must be a whole number, 1 to"):
        BenchmarkSettings.for_task("spacecraft", agents=(count,))
    with pytest.raises(ValueError, match=f"agents={count} must be a whole number, 1 to"):
        preset_named("swarm").for_agents(count)


@pytest.mark.parametrize("time", [0.0, 1e-12, 0.05, 1e9, 1e300, 10**400])
def test_an_episode_has_a_step_and_not_endlessly_many(time):
    from lagros_envs.tasks.cartpole.task import CartPoleSettings
    from lagros_envs.tasks.spacecraft.task import SpacecraftSettings

    for kind in (CartPoleSettings, SpacecraftSettings):
        with pytest.raises(ValueError, match="time_limit="):
            kind(time_limit=time)

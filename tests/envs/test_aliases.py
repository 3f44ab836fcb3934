"""Old names of modules: each gives what is at the new place, and says so once."""

import importlib
import sys
import warnings

import pytest

import lagros_envs.tasks.moved
import lagros_policies.tasks.moved
from lagros_benchmarks.tasks import moved as moved_benchmarks

FILTER = "lagros_policies.tasks.spacecraft.safety_filter"
NETWORKS = "lagros_policies.tasks.spacecraft.network_policy"
SLIDING = "lagros_policies.tasks.spacecraft.sliding"
TABLE = {
    **lagros_envs.tasks.moved.MOVED,
    **lagros_policies.tasks.moved.MOVED,
    **moved_benchmarks.MOVED,
}


def noted(function):
    """Return what a function gives, and the texts of the warnings on the way."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        value = function()
    return value, [one for one in caught if one.category is DeprecationWarning]


def forget(name):
    """Forget an old name, so that it is imported anew."""
    sys.modules.pop(name, None)
    package, _, last = name.rpartition(".")
    vars(sys.modules.get(package, sys)).pop(last, None)


@pytest.mark.parametrize("old", TABLE)
def test_an_old_name_imports_the_module_at_its_new_place(old):
    forget(old)
    found, said = noted(lambda: importlib.import_module(old))
    new = importlib.import_module(TABLE[old])
    assert found is new
    # The module does not notice that it has been asked for by another name.
    assert new.__name__ == new.__spec__.name == TABLE[old]
    mine = [one for one in said if str(one.message).startswith(f"{old} has moved to ")]
    assert len(mine) == 1
    assert TABLE[old] in str(mine[0].message)
    assert noted(lambda: importlib.import_module(old)) == (new, [])


def test_the_warning_is_of_who_imports():
    forget("lagros_envs.cartpole_task")

    def imports():
        import lagros_envs.cartpole_task

        return lagros_envs.cartpole_task

    _, (said,) = noted(imports)
    assert said.filename == __file__


def test_modules_of_a_package_that_has_moved_are_not_imported_twice():
    """Python would find them below the new place by the old name once more."""
    for name in ("lagros_policies.imitation", "lagros_policies.imitation.shards"):
        forget(name)
        found, _ = noted(lambda name=name: importlib.import_module(name))
    assert found is importlib.import_module("lagros_policies.learning.shards")


@pytest.mark.parametrize(
    ("module", "name", "home"),
    [
        ("lagros_envs.dynamics", "CartPole", "lagros_envs.tasks.cartpole.physics"),
        ("lagros_envs.dynamics", "Spacecraft", "lagros_envs.tasks.spacecraft.physics"),
        ("lagros_policies.expert", "CartPoleExpert", "lagros_policies.tasks.cartpole.expert"),
        ("lagros_policies.safety", "SafetyFilter", FILTER),
        ("lagros_policies.learned", "SpacecraftLearnedPolicy", NETWORKS),
        ("lagros_policies.lagros", "SpacecraftLagrosPolicy", NETWORKS),
        ("lagros_policies.tasks.cartpole.remarks", "SlidingCentralizedPolicy", SLIDING),
        ("lagros_policies.remarks.lagrangian", "SlidingTracking", SLIDING),
        ("lagros_benchmarks.report", "print_report", "lagros_benchmarks.report.delivery"),
    ],
)
def test_a_name_that_has_left_a_module_is_found_in_it(module, name, home):
    found, said = noted(lambda: getattr(importlib.import_module(module), name))
    assert found is getattr(importlib.import_module(home), name)
    assert [str(one.message) for one in said] == [
        f"{module}.{name} has moved to {home}.{name}; the old name goes with the next release"
    ]


def test_what_has_never_been_is_not_found():
    with pytest.raises(ModuleNotFoundError, match=r"lagros_envs\.nothing"):
        importlib.import_module("lagros_envs.nothing")
    with pytest.raises(ModuleNotFoundError, match=r"lagros_benchmarks\.nothing"):
        importlib.import_module("lagros_benchmarks.nothing")
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        importlib.import_module("lagros_envs.dynamics").nothing  # noqa: B018


def test_no_old_name_hides_a_module_that_has_it_now():
    for old in TABLE:
        package = old.rpartition(".")[0]
        parent = noted(lambda package=package: importlib.import_module(package))[0]
        if parent.__name__ == package:
            assert importlib.machinery.PathFinder.find_spec(old, parent.__path__) is None, old

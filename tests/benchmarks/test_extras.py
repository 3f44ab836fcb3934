"""What an installation without an extra says, and whether the extras hold what the code imports."""

from __future__ import annotations

import ast
import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

from lagros_benchmarks.commands import cli
from lagros_benchmarks.commands.extras import MODULES, install_hint
from lagros_benchmarks.run import library
from lagros_policies.policy import NAMES
from lagros_policies.tasks.spacecraft import SPACECRAFT_NAMES
from tests.benchmarks import fakes
from tests.lowest import lowest

ROOT = Path(__file__).parents[2]
# Where the name of the import is not that of the distribution.
IMPORTS = {
    "stable-baselines3": "stable_baselines3",
    "pygame-ce": "pygame",
    "imageio-ffmpeg": "imageio_ffmpeg",
    "pillow": "PIL",
}
# What each package may import: required, and the extras that its functions ask for.
ALLOWED = {
    "lagros_envs": ("fast", "render"),
    "lagros_policies": ("policies", "train", "rl", "onnx", "ray", "dask"),
    "benchmarks/lagros_benchmarks": tuple(MODULES),
}


def required(requirements):
    """The names of the imports of a list of requirements, our own extras left out."""
    names = [re.match(r"[A-Za-z0-9_.-]+", line).group() for line in requirements]
    return {IMPORTS.get(name, name) for name in names if name != "lagros"}


@pytest.fixture(scope="module")
def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_the_table_of_modules_is_that_of_the_extras(project):
    extras = project["optional-dependencies"]
    assert {name: set(modules) for name, modules in MODULES.items()} == {
        name: required(extras[name]) for name in MODULES
    }


@pytest.mark.parametrize("package", ALLOWED)
def test_a_package_imports_what_its_extras_install(project, package):
    known = required(project["dependencies"]) | {"lagros_envs", "lagros_policies"}
    # _typeshed is there for type checkers alone.
    known |= {"lagros_benchmarks", "_typeshed"} | set(sys.stdlib_module_names)
    known |= {module for extra in ALLOWED[package] for module in MODULES[extra]}
    found = set()
    for file in (ROOT / package).rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                found.add(str(node.module).partition(".")[0])
    assert found - known == set()


def test_the_extra_all_holds_every_extra_but_the_peers(project):
    extras = project["optional-dependencies"]
    (line,) = extras["all"]
    assert set(re.findall(r"[a-z0-9]+", line.partition("[")[2])) == set(extras) - {"all", "speed"}


def absent(modules):
    """The head of a script in which these packages are not installed."""
    return f"""
import json, sys
from importlib.machinery import PathFinder

found = PathFinder.find_spec

def find_spec(name, path=None, target=None):
    return None if name.partition(".")[0] in {set(modules)!r} else found(name, path, target)

PathFinder.find_spec = find_spec
"""


def python(code, folder=None):
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        capture_output=True,
        text=True,
        check=False,
    )


def with_extra_alone(project, extra):
    """The packages of the table that an extra, with those that it names, does not bring."""
    extras = project["optional-dependencies"]
    names, todo = set(), [extra]
    while todo:
        names.add(todo.pop())
        lines = " ".join(line for name in names for line in extras[name])
        todo += set(re.findall(r"[a-z]+", " ".join(re.findall(r"lagros\[(.*?)\]", lines)))) - names
    brought = set().union(*(required(extras[name]) for name in names))
    return {module for modules in MODULES.values() for module in modules} - brought


def outcomes(project, commands, folder):
    """Exit status and words of commands, with `lagros[bench]` alone, in one process."""
    code = f"""{absent(with_extra_alone(project, "bench"))}
from typer.testing import CliRunner
from lagros_benchmarks.commands import cli

for arguments in {[arguments.split() for arguments in commands]!r}:
    result = CliRunner().invoke(cli.app, arguments)
    print(json.dumps([result.exit_code, result.stderr, repr(result.exception)]))
"""
    result = python(code, folder)
    assert result.returncode == 0, result.stderr
    return [json.loads(line) for line in result.stdout.splitlines()]


@pytest.mark.slow
def test_the_extra_of_the_command_line_flies_draws_and_certifies(project, tmp_path):
    commands = [
        f"bench cartpole --episodes 1 --timing-episodes 1 --policies {','.join(NAMES)} --jobs 2",
        "bench spacecraft --episodes 1 --timing-episodes 1 --agents 2 --bound 0.4 "
        "--policies lagros --figure a.png --scene b.svg --json c.json",
        "watch cartpole --seconds 0.5 --video d.gif",
        *(
            f"watch spacecraft --policy {name} --agents 2 --seconds 0.5 --video {name}.gif"
            for name in SPACECRAFT_NAMES
        ),
        "watch spacecraft --agents 2 --seconds 0.5 --safety-filter --video e.gif",
        "attack cartpole --episodes 1 --budget 60 --npz f.npz",
        "certify spacecraft --episodes 0",
        "export learned-cartpole --out g.c",
        "export lagros-cartpole --out h.c",
    ]
    found = outcomes(project, commands, tmp_path)
    assert len(found) == len(commands)
    for command, (status, words, exception) in zip(commands, found, strict=True):
        assert status == 0, f"{command}: {words} {exception}"
    assert {path.suffix for path in tmp_path.iterdir()} >= {".png", ".svg", ".gif", ".npz", ".c"}


def test_what_needs_another_extra_names_it_before_it_works(project, tmp_path):
    needs = {
        "train cartpole --segments 1": "rl",
        "train spacecraft --segments 1": "rl",
        "reproduce cartpole": "train",
        "reproduce spacecraft": "train",
        "data export --minari": "data",
        "attack cartpole --method cma": "attack",
        "watch cartpole --policy lqr --video a.mp4": "video",
        "bench cartpole --episodes 1 --backend ray": "ray",
        "bench cartpole --episodes 1 --backend dask": "dask",
        "reproduce cartpole --shipped-weights --episodes 1 --backend ray": "ray",
    }
    found = outcomes(project, needs, tmp_path)
    for (command, extra), (status, words, exception) in zip(needs.items(), found, strict=True):
        assert status == 1, f"{command}: {words} {exception}"
        assert exception == "SystemExit(1)", command
        assert f"pip install 'lagros[{extra}]'" in words.replace('"', "'"), command
        assert len(words.strip().splitlines()) == 1, words
    assert list(tmp_path.glob("**/*.*")) == []


def test_every_policy_flies_with_its_extra_alone(project):
    code = f"""{absent(with_extra_alone(project, "policies"))}
import gymnasium, lagros_envs, lagros_policies, numpy as np
from lagros_envs import spacecraft_v0
from lagros_policies.policy import NAMES
from lagros_policies.tasks.spacecraft import SPACECRAFT_NAMES

env = gymnasium.make("lagros/CartPole-v0")
for name in NAMES:
    policy, (seen, _), memory = lagros_policies.make(name, env), env.reset(seed=1), None
    for first in (True, False):
        action, memory = policy.predict(seen, memory, np.array([first]))
        seen, *_ = env.step(action)
world = spacecraft_v0.parallel_env(num_agents=2)
for name in SPACECRAFT_NAMES:
    policy, (seen, _) = lagros_policies.make(name, world), world.reset(seed=1)
    together = getattr(policy, "observes", "local") == "global"
    seen = world.state()[None] if together else np.stack(list(seen.values()))
    actions, _ = policy.predict(seen, None, np.ones(len(seen), bool))
    world.step(dict(zip(world.agents, np.reshape(actions, (2, -1)), strict=True)))
print(*sorted({{name.partition(".")[0] for name in sys.modules}}))
"""
    result = python(code)
    assert result.returncode == 0, result.stderr
    assert set(MODULES["policies"]) <= set(result.stdout.split()) | {"clarabel"}


def test_every_policy_names_the_extra_that_flies_it(project):
    code = f"""{absent(MODULES["policies"])}
import gymnasium, lagros_envs, lagros_policies
from lagros_envs import spacecraft_v0
from lagros_policies.policy import NAMES
from lagros_policies.tasks.spacecraft import SPACECRAFT_NAMES

for env, names in (
    (gymnasium.make("lagros/CartPole-v0"), NAMES),
    (spacecraft_v0.parallel_env(num_agents=2), SPACECRAFT_NAMES),
):
    for name in names:
        try:
            lagros_policies.make(name, env)
        except ImportError as error:
            print(name, "pip install 'lagros[policies]'" in str(error))
        else:
            print(name, "needs nothing")
"""
    result = python(code)
    assert result.returncode == 0, result.stderr
    assert result.stdout.split("\n")[:-1] == [
        *(f"{name} {'needs nothing' if name == 'random' else 'True'}" for name in NAMES),
        *(f"{name} True" for name in SPACECRAFT_NAMES),
    ]


@pytest.mark.parametrize(
    ("module", "arguments", "extra"),
    [
        ("typer", ("--help",), "bench"),
        ("scipy", ("bench", "cartpole", "--episodes", "1"), "policies"),
        ("scipy", ("certify", "cartpole", "--episodes", "0"), "policies"),
    ],
)
def test_a_command_without_its_extra_says_what_to_install(module, arguments, extra):
    code = f"""{absent([module])}
sys.argv = ["lagros", *{arguments!r}]
from lagros_benchmarks.__main__ import main
main()
"""
    result = python(code)
    assert result.returncode == 1
    assert f"pip install 'lagros[{extra}]' brings {module}" in result.stderr
    assert "Traceback" not in result.stderr


def test_the_hint_is_found_behind_the_error_that_it_caused(monkeypatch, tmp_path):
    def absent(name, env, settings):
        raise ModuleNotFoundError("No module named 'clarabel'", name="clarabel")

    toolbox = library.Toolbox(absent, fakes.easy_planner, fakes.load_metric)
    monkeypatch.setattr("lagros_benchmarks.run.runner.Toolbox", lambda: toolbox)
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(cli.app, ["bench", "cartpole"])
    assert result.exit_code == 1
    assert "policy 'learned' cannot be built" in result.stderr
    assert "; pip install 'lagros[policies]' brings clarabel" in result.stderr


def test_other_errors_have_no_hint():
    assert install_hint(ValueError("scipy")) == ""
    assert install_hint(ModuleNotFoundError("No module named 'mine'", name="mine")) == ""


def test_python_m_is_the_command():
    result = subprocess.run(
        [sys.executable, "-m", "lagros_benchmarks", "--version"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert result.stdout.startswith("lagros ")


def test_the_lowest_versions_of_an_extra_are_those_of_its_ranges(project):
    found = lowest(project, "bench")
    assert set(found) == {
        re.match(r"[a-z0-9-]+", line).group()
        for lines in (
            project["dependencies"],
            *(project["optional-dependencies"][name] for name in ("bench", "policies", "render")),
        )
        for line in lines
        if not line.startswith("lagros")
    }
    pinned = dict(
        line.split("==")
        for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
        if not line.startswith("#")
    )
    for name, version in found.items():
        ours, first = (tuple(map(int, text.split("."))) for text in (pinned[name], version))
        assert first <= ours

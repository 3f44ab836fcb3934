"""What an installation without an extra says, and whether the extras hold what the code imports."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

from lagros_benchmarks import cli, library
from lagros_benchmarks.extras import MODULES, install_hint
from tests.benchmarks import fakes

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
    known |= {"lagros_benchmarks"} | set(sys.stdlib_module_names)
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


def without(module, *arguments):
    """Run the command in a process in which a package cannot be imported."""
    code = f"""
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == {module!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Absent())
sys.argv = ["lagros", *{arguments!r}]
from lagros_benchmarks.__main__ import main
main()
"""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("module", "arguments", "extra"),
    [
        ("typer", ("--help",), "bench"),
        ("scipy", ("bench", "cartpole", "--episodes", "1"), "policies"),
        ("scipy", ("certify", "cartpole", "--episodes", "0"), "policies"),
    ],
)
def test_a_command_without_its_extra_says_what_to_install(module, arguments, extra):
    result = without(module, *arguments)
    assert result.returncode == 1
    assert f"pip install 'lagros[{extra}]' brings {module}" in result.stderr
    assert "Traceback" not in result.stderr


def test_the_hint_is_found_behind_the_error_that_it_caused(monkeypatch, tmp_path):
    def absent(name, env, settings):
        raise ModuleNotFoundError("No module named 'clarabel'", name="clarabel")

    toolbox = library.Toolbox(absent, fakes.easy_planner, fakes.load_metric)
    monkeypatch.setattr("lagros_benchmarks.runner.Toolbox", lambda: toolbox)
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

"""The house: imports point downwards, tasks are named in their folders, modules stay readable."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = {
    "lagros_envs": ROOT / "lagros_envs",
    "lagros_policies": ROOT / "lagros_policies",
    "lagros_benchmarks": ROOT / "benchmarks" / "lagros_benchmarks",
}
FILES = sorted(path for folder in PACKAGES.values() for path in folder.rglob("*.py"))
# Of the packages above, none may be imported, not even inside a function.
ABOVE = {
    "lagros_envs": ("lagros_policies", "lagros_benchmarks"),
    "lagros_policies": ("lagros_benchmarks",),
    "lagros_benchmarks": (),
}
# What the environments need: nothing else is imported where they are.
OF_ENVIRONMENTS = {"gymnasium", "lagros_envs", "numpy", "pettingzoo"}
# Imported by modules that are themselves imported where `compiled=True` asks for them.
OF_COMPILED = {"llvmlite", "numba"}
# Where a task may be named.
NAMED = re.compile(r"/tasks/|/pretrained/|lagros_envs/spacecraft_v0\.py$|lagros_envs/__init__\.py$")
LONGEST = 400
TASKS = [file.parent.name for file in (ROOT / "lagros_envs" / "tasks").glob("*/__init__.py")]


def place(path):
    return str(path.relative_to(ROOT))


def imported(path):
    """Yield each module that a file imports, and whether it is imported with the file itself."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    inside = {
        id(node)
        for parent in ast.walk(tree)
        if isinstance(parent, ast.FunctionDef | ast.Lambda) or _only_for_types(parent)
        for node in ast.walk(parent)
    }
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        for name in names:
            yield name, id(node) not in inside


def _only_for_types(node):
    return isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")


@pytest.mark.parametrize("package", PACKAGES)
def test_imports_point_downwards(package):
    wrong = [
        f"{place(path)} imports {name}"
        for path in PACKAGES[package].rglob("*.py")
        for name, _ in imported(path)
        if name.partition(".")[0] in ABOVE[package]
    ]
    assert not wrong


def test_the_environments_need_three_libraries():
    import sys

    wrong = [
        f"{place(path)} imports {name}"
        for path in PACKAGES["lagros_envs"].rglob("*.py")
        for name, at_once in imported(path)
        if at_once
        and (first := name.partition(".")[0])
        not in OF_ENVIRONMENTS | {"lagros_envs", "llvmlite", "numba"}
        and first not in sys.stdlib_module_names
    ]
    assert not wrong


def test_general_code_does_not_import_a_task():
    wrong = [
        f"{place(path)} imports {name}"
        for path in FILES
        if not NAMED.search(place(path))
        for name, _ in imported(path)
        # The table of names that have moved is no task.
        if re.match(r"lagros_\w+\.tasks\.(?!moved)\w", name)
    ]
    assert not wrong


@pytest.mark.parametrize("path", FILES, ids=place)
def test_a_task_is_named_in_its_folder_only(path):
    if NAMED.search(place(path)):
        return
    text = path.read_text(encoding="utf-8")
    assert not [name for name in TASKS if naming(name).search(text)]


@pytest.mark.parametrize(
    "text", ["a car", "car_metric.json", "CarSettings", "./car.py", "tasks.car"]
)
def test_a_short_name_is_found_as_a_word(text):
    assert naming("car").search(text)
    assert not naming("car").search("carry scarce Carefully")


def naming(name):
    """Return what finds a task's name in code: a short one as a word, or as one of CamelCase."""
    if len(name) > 4:
        return re.compile(rf"{name}|{name[:4]}-?{name[4:]}", re.IGNORECASE)
    return re.compile(rf"(?<![a-zA-Z]){name}(?![a-z])|{name.title()}(?![a-z])")


@pytest.mark.parametrize("path", FILES, ids=place)
def test_a_module_can_be_read_at_one_sitting(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= LONGEST


def test_the_top_floor_of_the_benchmark_has_few_rooms():
    entries = [
        path for path in PACKAGES["lagros_benchmarks"].iterdir() if path.name != "__pycache__"
    ]
    assert len([path for path in entries if path.is_dir()]) <= 10
    assert {path.name for path in entries if path.is_file()} <= {
        "__init__.py",
        "__main__.py",
        "py.typed",
    }

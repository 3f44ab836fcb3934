"""Every command of every page can be typed as it stands there: it parses, and its options exist."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import re
import sys
import tomllib
from pathlib import Path

import pytest
import typer
import typer.main

from lagros_benchmarks.commands import cli
from tests import documents

ROOT = Path(__file__).parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "benchmarks" / "studies").glob("*.md")),
]
SOURCES = ("benchmarks", "examples", "lagros_envs", "lagros_policies", "tests")
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
# What the command line raises; typer brings a click of its own.
USAGE_ERROR = next(base for base in typer.BadParameter.__mro__ if base.__name__ == "UsageError")
# "ppo|sac|td3" stands for one of them.
EXTRAS = re.compile(r"(?:lagros|\.)\[([a-z,]+)\]")
CHOICE = re.compile(r"(\w+)(\|\w+)+")


def named(paths):
    return [pytest.param(path, id=str(path.relative_to(ROOT))) for path in paths]


def check_lagros(words):
    """Let the command line itself parse it, which raises on unknown options and wrong values."""
    command = typer.main.get_command(cli.app)
    arguments = [CHOICE.sub(r"\1", word) for word in words]
    while hasattr(command, "resolve_command") and arguments and not arguments[0].startswith("-"):
        context = command.make_context("lagros", list(arguments), resilient_parsing=True)
        name, command, arguments = command.resolve_command(context, arguments)
        assert command is not None, f"there is no command {name}"
    command.make_context("lagros", list(arguments))


def check_python(words):
    """A script or module is there, and the text of its folder knows every option."""
    if words[0] == "-m":
        for statement in re.findall(r"from lagros\S* import \w+", " ".join(words)):
            exec(statement, {})
        if words[1] in ("venv", "pytest", "pip", "timeit"):
            return
        spec = importlib.util.find_spec(words[1])
        assert spec is not None, words
        file, options = Path(spec.origin), words[2:]
    else:
        file, options = ROOT / words[0], words[1:]
        assert file.is_file(), words
    known = "".join(path.read_text(encoding="utf-8") for path in file.parent.glob("*.py"))
    for option in options:
        if option.startswith("--"):
            # As it is given to argparse, or the field of settings that becomes an option.
            field = option.removeprefix("--").replace("-", "_")
            found = f'"{option}"' in known or re.search(rf"^    {field}: ", known, re.MULTILINE)
            assert found, f"{file.name} has no {option}"


def check_make(words):
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for word in words:
        if "=" not in word:
            assert re.search(rf"^{re.escape(word)}:", makefile, re.MULTILINE), word


def check_pip(words):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for names in EXTRAS.findall(" ".join(words)):
        for name in names.split(","):
            assert name in project["optional-dependencies"], f"there is no extra {name}"


CHECKS = {"lagros": check_lagros, "python": check_python, "make": check_make, "pip": check_pip}


def check_commands(text):
    found = documents.commands(text)
    for line, (program, *words) in found:
        try:
            CHECKS.get(program.rpartition("/")[2], lambda words: None)(words)
        except (USAGE_ERROR, AssertionError, ImportError) as error:
            message = getattr(error, "message", None) or error
            pytest.fail(f"line {line}: {' '.join([program, *words])}: {message}")
    return found


@pytest.mark.parametrize("page", named(PAGES))
def test_the_commands_of_a_page_can_be_typed(page):
    check_commands(page.read_text(encoding="utf-8"))


def test_the_pages_have_commands():
    counts = [len(documents.commands(page.read_text(encoding="utf-8"))) for page in PAGES]
    assert sum(counts) > 100
    assert counts[0] >= 10


@pytest.mark.parametrize("example", named(EXAMPLES))
def test_the_commands_of_an_example_can_be_typed(example):
    assert check_commands(example.read_text(encoding="utf-8"))


@pytest.mark.parametrize("page", named(PAGES))
def test_the_extras_that_a_page_names_exist(page):
    check_pip(page.read_text(encoding="utf-8").split())


@pytest.mark.parametrize("page", named(PAGES))
def test_what_the_python_of_a_page_imports_from_us_is_there(page):
    for block in documents.python_blocks(page.read_text(encoding="utf-8")):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith("lagros"):
                for alias in node.names:
                    if not hasattr(importlib.import_module(node.module), alias.name):
                        importlib.import_module(f"{node.module}.{alias.name}")


@pytest.mark.parametrize("example", named(EXAMPLES))
def test_the_extra_that_an_example_names_brings_what_it_imports(example):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    text = example.read_text(encoding="utf-8")
    (extra,) = EXTRAS.findall(text)
    lines = [*project["dependencies"], *project["optional-dependencies"][extra]]
    brought = {re.match(r"[A-Za-z0-9_-]+", line).group().replace("-", "_") for line in lines}
    brought |= {"lagros_envs", "lagros_policies"}
    imported = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            imported |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add(str(node.module).partition(".")[0])
    assert imported - set(sys.stdlib_module_names) <= brought


@pytest.mark.parametrize("page", named(PAGES))
def test_what_a_page_links_to_is_there(page):
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        if "://" not in target:
            assert (page.parent / target).exists(), target


@pytest.mark.parametrize("page", named([ROOT / "CONTRIBUTING.md", ROOT / "docs/architecture.md"]))
def test_the_modules_that_a_page_names_are_there(page):
    places = [path for folder in SOURCES for path in (ROOT / folder).rglob("*.py")]
    for name in re.findall(r"`([\w./]+\.py)`", page.read_text(encoding="utf-8")):
        assert any(str(path).endswith(f"/{name}") for path in places), name


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("    lagros bench cartpole\n        --json x.json\n", "line 2 is no command"),
        ("```console\nlagros bench cartpole\n--json x.json\n```\n", "line 3 is no command"),
        ("    lagros bench cartpole --jsn x.json\n", "--jsn"),
        ("    lagros bench cartpole --episodes many\n", "many"),
        ("    lagros bnch cartpole\n", "no command"),
        ("    python benchmarks/speed/run.py --no-such-option\n", "no --no-such-option"),
        ("    make nothing\n", "nothing"),
        ('    pip install "lagros[none]"\n', "no extra none"),
    ],
)
def test_a_command_that_cannot_be_typed_is_found(text, complaint):
    with pytest.raises((ValueError, pytest.fail.Exception), match=complaint):
        check_commands(text)


def test_commands_are_taken_apart_as_a_shell_does():
    long = '    A=1 lagros bench x \\\n        --json "a b"  # why\n'
    text = f"Prose.\n\n{long}\n    make && make test\n"
    assert documents.commands(text) == [
        (3, ("lagros", "bench", "x", "--json", "a b")),
        (6, ("make",)),
        (6, ("make", "test")),
    ]
    assert documents.commands("    return x\n\nprose\n    lagros in prose\n") == []

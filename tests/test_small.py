"""Every snippet and every command of the site is run, the long ones at small size."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from tests import documents, first_half, small
from tests.test_documents import check_lagros

ROOT = small.ROOT
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
# What a page takes for granted: models that the reader has trained.
PREPARED = {
    "docs/baselines.md": 'SAC("MlpPolicy", gym.make("lagros/CartPole-v0")).save("model.zip")',
    "docs/disturb.md": 'PPO("MlpPolicy", gym.make("Pendulum-v1")).save("ppo.zip")',
    "docs/comparing.md": (
        'worlds = VecNormalize(DummyVecEnv([lambda: gym.make("lagros/CartPole-v0")]))\n'
        'PPO("MlpPolicy", worlds).save("ppo.zip"); worlds.save("vecnormalize.pkl")'
    ),
}
_HEAD = """import gymnasium as gym, lagros_envs
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
"""
# Of an adapter of the reader's own the page shows no environment; test_disturb.py runs it.
_OF_A_TEST = {"docs/disturb.md"}


def name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def own(page: Path) -> list[tuple[str, ...]]:
    """Return the commands of a page that are run at small size, here."""
    found = documents.commands(page.read_text(encoding="utf-8"))
    return [one.words for one in found if small.runner(name(page), one.words) is None]


RUN_HERE = [
    page
    for page in PAGES
    if name(page) not in small.PAGES
    and (own(page) or documents.python_blocks(page.read_text(encoding="utf-8")))
]


def test_every_command_is_run_by_a_test_and_at_small_size_if_by_none_of_its_own() -> None:
    total = 0
    for page in PAGES:
        for command in documents.commands(page.read_text(encoding="utf-8")):
            total += 1
            test = small.runner(name(page), command.words)
            if test is None:
                made = small.small(command.words)
                assert made, (name(page), " ".join(command.words))
                if made[0] == "lagros":
                    check_lagros(made[1:])
            else:
                assert (ROOT / test).exists(), test
    assert total > 80


def test_a_command_that_nobody_runs_is_found() -> None:
    assert small.small(("python", "benchmarks/studies/conformal.py")) is None
    assert small.small(("lagros", "doctor")) is None
    assert small.runner("docs/speed.md", ("make", "speed")) == "tests/benchmarks/test_speed.py"
    words = (
        "lagros",
        "bench",
        "car",
        "--episodes",
        "200",
        "--quiet",
        "--bound",
        "1",
        "--jobs",
        "2",
    )
    behind = ["--bound", "1", "--episodes", "1", "--quiet", "--jobs", "1"]
    assert small.small(words) == ("lagros", "bench", "car", *behind)
    assert small.smaller("learn(350_000, episodes=20)") == "learn(64, episodes=1)"


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("page", RUN_HERE, ids=map(name, RUN_HERE))
def test_what_a_page_says_runs(page: Path, tmp_path: Path) -> None:
    text = page.read_text(encoding="utf-8")

    def run(*words: str) -> None:
        done = subprocess.run(
            words,
            cwd=tmp_path,
            env=documents.environment(),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )
        # 1 of `certify`: something does not hold, which so little time may bring.
        fine = {0, 1} if words[:2] == ("lagros", "certify") else {0}
        said = (words, done.stdout[-2000:], done.stderr[-2000:])
        assert done.returncode in fine, said
        assert "Traceback" not in done.stderr, said

    # What a command names of the repository is there under the same name.
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    if name(page) in PREPARED:
        run("python", "-c", _HEAD + PREPARED[name(page)])
    # A page may speak of the modules that the README shows.
    first_half.write_modules((ROOT / "README.md").read_text(encoding="utf-8"), tmp_path)
    first_half.write_modules(text, tmp_path)
    # What is typed above the first snippet comes first; it may make what the snippet reads.
    above = len(text.partition("```python\n")[0].splitlines())
    typed = [(one.line, one.words) for one in documents.commands(text)]
    before = [words for line, words in typed if line <= above]
    blocks = [small.smaller(block) for block in documents.python_blocks(text)]
    (tmp_path / "blocks.py").write_text("\n\n".join(blocks), encoding="utf-8")
    python = [] if name(page) in _OF_A_TEST else [("python", "blocks.py")]
    after = [words for line, words in typed if line > above]
    for words in [*before, *python, *after]:
        if words == ("python", "blocks.py"):
            run(*words)
        elif small.runner(name(page), words) is None:
            made = small.small(words)
            assert made is not None
            run(*made)

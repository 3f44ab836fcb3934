"""Does a change move a digit? Run seeded episodes and commands on two revisions and compare them.

    python benchmarks/digits.py REVISION            # the working tree against a revision
    python benchmarks/digits.py REVISION --rows bench   # only the rows whose names hold "bench"

Both sides run here, one after the other, on the same processor and libraries: figures that are
compared across machines differ in their last digits. Everything is compared but times and the
names of the machine and its libraries; what only the working tree has is counted and is no
difference. The exit status is 1 where something differs.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
KINDS = ("none", "uniform", "sphere", "constant", "sinusoid", "gust")
# Entries that a clock, a machine or the command's own text decides.
UNCOMPARED = re.compile(
    r"(^|\.)(command|machine|threads|versions)(\.|\[|$)|(step|plan|forward|batch)_time_"
    r"|deadline_misses|seconds$|late_plans|^time$"
)

CARTPOLE = ("bench", "cartpole", "--episodes", "3", "--disturbance", "uniform,constant")
SPACECRAFT = ("bench", "spacecraft", "--episodes", "1", "--bound", "0.4", "--agents", "3")
# Name, command line and the file that it writes.
COMMANDS: dict[str, tuple[str, ...]] = {
    "bench cartpole": (
        *CARTPOLE,
        "--policies",
        "learned,tube-mpc,lagros,lqr,random,ppo,sac,td3,residual",
        "--json",
    ),
    "bench cartpole, episodes": (*CARTPOLE, "--policies", "lagros,tube-mpc", "--episodes-file"),
    "bench cartpole, worst": (
        *("bench", "cartpole", "--episodes", "2", "--disturbance", "worst"),
        *("--policies", "lagros,lqr", "--json"),
    ),
    "bench spacecraft": (
        *SPACECRAFT,
        "--policies",
        "learned,tube-mpc,lagros,centralized,ppo",
        "--json",
    ),
    "bench spacecraft, episodes": (*SPACECRAFT, "--policies", "lagros", "--episodes-file"),
    "attack cartpole": ("attack", "cartpole", "--episodes", "1", "--budget", "40", "--json"),
    "attack spacecraft": ("attack", "spacecraft", "--episodes", "1", "--budget", "4", "--json"),
    "certify cartpole": ("certify", "cartpole", "--episodes", "4", "--json"),
    "certify spacecraft": ("certify", "spacecraft", "--episodes", "1", "--json"),
    "export lagros-cartpole": ("export", "lagros-cartpole", "--out"),
    "export learned-spacecraft": ("export", "learned-spacecraft", "--out"),
}


def main() -> int:
    """Compare the working tree with a revision; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("revision", nargs="?", help="what to compare the working tree with")
    parser.add_argument("--rows", default="", help="only rows whose names hold this text")
    parser.add_argument("--probe", type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.probe is not None:
        asked.probe.write_text(json.dumps(_digits(asked.rows)), encoding="utf-8")
        return 0
    if asked.revision is None:
        parser.error("name a revision to compare with, for instance HEAD~1")
    with _checkout(asked.revision) as before:
        sides = [_probed(tree, asked.rows) for tree in (before, ROOT)]
    return _report(*sides)


@contextmanager
def _checkout(revision: str) -> Iterator[Path]:
    """Give a temporary work tree of the revision."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        git = ("git", "-C", str(ROOT), "worktree")
        subprocess.run(
            [*git, "add", "--detach", str(tree), revision], check=True, capture_output=True
        )
        try:
            yield tree
        finally:
            subprocess.run([*git, "remove", "--force", str(tree)], check=True)


def _probed(tree: Path, rows: str) -> dict[str, Any]:
    """Return the digits of a tree, found by this very script in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "digits.json"
        paths = os.pathsep.join([str(tree), str(tree / "benchmarks")])
        subprocess.run(
            [sys.executable, str(Path(__file__)), "--probe", str(out), "--rows", rows],
            check=True,
            cwd=folder,
            env={**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1"},
        )
        found: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))
        return found


def _report(before: dict[str, Any], after: dict[str, Any]) -> int:
    """Print every row and where it differs; return the exit status."""
    different = 0
    for name in before | after:
        old, new = dict(_leaves(before.get(name))), dict(_leaves(after.get(name)))
        changed = [place for place in old if repr(old[place]) != repr(new.get(place, "(gone)"))]
        added = sorted(new.keys() - old.keys())
        different += bool(changed)
        note = f", with {len(added)} more entries such as {added[0]}" if added else ""
        print(f"{'DIFFERS' if changed else 'same':8} {name}{note}")
        for place in changed[:5]:
            print(f"           {place}: {old[place]!r} -> {new.get(place, '(gone)')!r}")
        if len(changed) > 5:
            print(f"           and {len(changed) - 5} more")
    print(f"{different} of {len(before | after)} rows differ")
    return int(different > 0)


def _leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Give every number and text of a nested value with its place, but those not compared."""
    if UNCOMPARED.search(path):
        return
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _leaves(inner, f"{path}.{key}" if path else key)
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from _leaves(inner, f"{path}[{index}]")
    else:
        yield path, value


def _digits(rows: str) -> dict[str, Any]:
    """Return what the packages on the path compute, by row."""
    probes: dict[str, Callable[[], Any]] = {}
    for kind in KINDS:
        probes[f"cartpole episode, {kind}"] = lambda kind=kind: _cartpole_episode(kind)
        probes[f"cartpole worlds, {kind}"] = lambda kind=kind: _cartpole_worlds(kind)
        probes[f"spacecraft world, {kind}"] = lambda kind=kind: _spacecraft_world(kind)
    probes["spacecraft alone"] = _spacecraft_alone
    probes["cartpole plans"] = _cartpole_plans
    for name, command in COMMANDS.items():
        probes[name] = lambda command=command: _written(command)
    found = {}
    for name, probe in probes.items():
        if rows in name:
            print(f"  {name}", file=sys.stderr)
            found[name] = probe()
    return found


def _cartpole_episode(kind: str) -> Any:
    import gymnasium as gym

    import lagros_envs  # noqa: F401

    env = gym.make(
        "lagros/CartPole-v0",
        disturbance=kind,
        disturbance_bound=0.75,
        disable_env_checker=True,
    )
    rows = []
    for seed in (0, 7, 2**40):
        observation, _ = env.reset(seed=seed)
        rng = np.random.default_rng(seed)
        over = False
        while not over:
            force = np.float32([4.0 * observation[1] + observation[3] + rng.normal()])
            observation, reward, terminated, truncated, info = env.step(force)
            over = terminated or truncated
            rows.append([*env.unwrapped.state.tolist(), float(reward), float(info["effort"])])
    return rows


def _cartpole_worlds(kind: str) -> Any:
    import gymnasium as gym

    import lagros_envs  # noqa: F401

    envs: Any = gym.make_vec(
        "lagros/CartPole-v0",
        num_envs=3,
        vectorization_mode="vector_entry_point",
        disturbance=kind,
        compiled=False,
        autoreset_mode="disabled",
    ).unwrapped
    envs.reset(seed=[1, 2, 3])
    rng = np.random.default_rng(0)
    rows = []
    for _ in range(20):
        _, rewards, *_ = envs.step(np.float32(0.1 * rng.normal(size=(3, 1))))
        rows.append([envs.state.tolist(), rewards.tolist()])
    return rows


def _spacecraft_world(kind: str) -> Any:
    from lagros_envs import spacecraft_v0

    world = spacecraft_v0.parallel_env(num_agents=4, disturbance=kind, disturbance_bound=0.6)
    rows = []
    for seed in (0, 3):
        world.reset(seed=seed)
        rng = np.random.default_rng(seed)
        for _ in range(30):
            if not world.agents:
                break
            actions = {name: np.float32(rng.random(8)) for name in world.agents}
            _, rewards, *_ = world.step(actions)
            rows.append([world.state().tolist(), sorted(rewards.items())])
    return rows


def _spacecraft_alone() -> Any:
    import gymnasium as gym

    import lagros_envs  # noqa: F401

    env = gym.make("lagros/Spacecraft-v0", disturbance="uniform", disable_env_checker=True)
    observation, _ = env.reset(seed=5)
    rng = np.random.default_rng(5)
    rows = [observation.tolist()]
    for _ in range(30):
        observation, reward, *_ = env.step(np.float32(rng.random(8)))
        rows.append([*observation.tolist(), float(reward)])
    return rows


def _cartpole_plans() -> Any:
    import gymnasium as gym

    import lagros_envs  # noqa: F401
    import lagros_policies

    made: Any = lagros_policies.make("tube-mpc", gym.make("lagros/CartPole-v0"))
    planner = made.expert.planner
    plans = [
        planner.plan(np.array([0.0, angle, 0.0, 0.0]), np.array([goal, 0.0, 0.0, 0.0]))
        for angle, goal in ((0.5, 2.0), (-1.0, 4.5))
    ]
    return [[plan.states.tolist(), float(plan.defect)] for plan in plans]


def _written(command: tuple[str, ...]) -> Any:
    """Return what a command of `lagros` writes to the file that is its last option."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / f"out.{'c' if command[0] == 'export' else 'json'}"
        run = subprocess.run(
            [sys.executable, "-m", "lagros_benchmarks", *command, str(out)],
            capture_output=True,
            text=True,
            check=False,
            cwd=folder,
        )
        if not out.is_file():
            return {"exit status": run.returncode, "said": run.stderr[-1000:]}
        text = out.read_text(encoding="utf-8")
        if command[0] == "export":
            # Layers in any order; what is around them the command itself compares with NumPy.
            layers = r"static const float (?!last)\w*(?:weight|bias)\w*\[\d+\] = \{(.*?)\};"
            return sorted(" ".join(found.split()) for found in re.findall(layers, text, re.DOTALL))
        if command[-1] == "--episodes-file":
            return [json.loads(line) for line in text.splitlines()]
        return json.loads(text)


if __name__ == "__main__":
    sys.exit(main())

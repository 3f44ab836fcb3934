"""One round of a peer that lives in an environment of its own, for every line read from stdin.

PYTHON benchmarks/speed/peers.py NAME, where PYTHON belongs to an environment with the peer: `vmas`
(pip install vmas) or `safe-control-gym` (from its repository; it is not on PyPI). `ratios.py` talks
to it, so that the peer takes turns with what it is compared with. It imports nothing of lagros.

The first line printed is a JSON object with the version; every further one the seconds of a round.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

_VMAS_STEPS = 10
# Worlds and agents of the round "random", and the steps of an episode, as in `learner.py`.
_CROWD, _CROWD_STEPS = (256, 6), 450
_STEPS = 200
_RESETS = 20


def main() -> None:
    """Answer every line with the seconds that a round took."""
    parser = argparse.ArgumentParser(description="Rounds of a peer.")
    parser.add_argument("name", choices=sorted(_PEERS))
    options = parser.parse_args()
    # What a peer prints must not come between the answers.
    answers, sys.stdout = sys.stdout, sys.stderr
    rounds, version = _PEERS[options.name]()
    print(json.dumps({"version": version, "rounds": sorted(rounds)}), file=answers, flush=True)
    for line in sys.stdin:
        print(rounds[line.strip()](), file=answers, flush=True)


def _vmas() -> tuple[dict[str, Callable[[], float]], str]:
    from importlib.metadata import version

    import torch
    import vmas

    torch.set_num_threads(1)
    worlds, agents = 1024, 4
    env = vmas.make_env(
        "navigation",
        num_envs=worlds,
        device="cpu",
        continuous_actions=True,
        seed=0,
        n_agents=agents,
    )

    def step() -> float:
        env.reset()
        actions = [[2.0 * torch.rand(worlds, 2) - 1.0] * agents for _ in range(_VMAS_STEPS)]
        begun = time.perf_counter()
        for action in actions:
            env.step(action)
        return (time.perf_counter() - begun) / _VMAS_STEPS

    crowd = vmas.make_env(
        "navigation",
        num_envs=_CROWD[0],
        device="cpu",
        continuous_actions=True,
        seed=0,
        n_agents=_CROWD[1],
        max_steps=_CROWD_STEPS,
    )

    def random() -> float:
        """Go on for as many steps as an episode has, and reset the worlds that end."""
        worlds, agents = _CROWD
        drawn = [[2.0 * torch.rand(worlds, 2) - 1.0] * agents for _ in range(_VMAS_STEPS)]
        begun = time.perf_counter()
        for step in range(_CROWD_STEPS):
            _, _, done, _ = crowd.step(drawn[step % _VMAS_STEPS])
            if done.all():
                crowd.reset()
            elif done.any():
                for world in torch.nonzero(done).flatten().tolist():
                    crowd.reset_at(world)
        return (time.perf_counter() - begun) / _CROWD_STEPS

    return {"step": step, "random": random}, version("vmas")


def _safe_control_gym() -> tuple[dict[str, Callable[[], float]], str]:
    from importlib.metadata import version

    from safe_control_gym.utils.registration import make

    env = make("cartpole", task="stabilization", ctrl_freq=10, pyb_freq=1000, gui=False)
    env.reset(seed=0)

    def step() -> float:
        total = 0.0
        for _ in range(_STEPS):
            action = env.action_space.sample()
            begun = time.perf_counter()
            _, _, done, _ = env.step(action)
            total += time.perf_counter() - begun
            if done:
                env.reset()
        return total / _STEPS

    def reset() -> float:
        begun = time.perf_counter()
        for _ in range(_RESETS):
            env.reset()
        return (time.perf_counter() - begun) / _RESETS

    return {"step": step, "reset": reset}, version("safe-control-gym")


_PEERS = {"vmas": _vmas, "safe-control-gym": _safe_control_gym}


if __name__ == "__main__":
    main()

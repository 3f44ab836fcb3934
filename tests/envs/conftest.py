"""What several tests of the environments need."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests import other_cpu

ROOT = Path(__file__).resolve().parents[2]
# A discrete LQR about the upright: it holds the pole from every start of the task. [N per unit]
GAIN = np.array([-0.21, -22.8, -1.2, -5.6])
# What tells the libraries which processor this is; other digits come of others.
KEPT = {name: os.environ[name] for name in other_cpu.settings() if name in os.environ}


@pytest.fixture
def hold():
    """Return the action that brings a state (..., 4) to a goal, in double precision.

    Double, because two roll-outs that differ by rounding must not have that amplified by float32.
    """

    def action(state, goal, force_scale=40.0):
        error = np.asarray(state - goal)
        position = np.clip(error[..., :1], -3.0, 3.0)
        error = np.concatenate([position, error[..., 1:]], axis=-1)
        return -(error @ GAIN)[..., None] / force_scale

    return action


@pytest.fixture
def run_python():
    """Run a script in a fresh interpreter and return what it prints."""

    def run(script, **environment):
        finished = subprocess.run(
            [sys.executable, "-W", "error", "-c", script],
            cwd=ROOT,
            env={**KEPT, **environment},
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert finished.returncode == 0, finished.stderr
        return finished.stdout

    return run

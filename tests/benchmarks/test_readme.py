"""The README's Python runs as it stands there, from its first block to its last."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

README = Path(__file__).parents[2] / "README.md"


def test_every_block_runs(capsys: pytest.CaptureFixture[str]) -> None:
    blocks = re.findall(r"^```python\n(.*?)^```", README.read_text(), re.MULTILINE | re.DOTALL)
    assert len(blocks) == 4
    names: dict[str, Any] = {}
    for block in blocks:
        exec(block, names)
    single, many = capsys.readouterr().out.splitlines()
    assert single.startswith("True ")
    assert len(many.split(",")) == 6

    # The policy of one's own answers one observation, and a batch of them row by row.
    env, envs, lean = names["env"], names["envs"], names["Lean"]
    policy = lean(env.unwrapped.settings)
    rows, _ = envs.reset(seed=2)
    actions, _ = policy.predict(rows)
    assert actions.shape == envs.action_space.shape
    one, _ = policy.predict(rows[0])
    assert env.action_space.shape == one.shape
    np.testing.assert_array_equal(one, actions[0])

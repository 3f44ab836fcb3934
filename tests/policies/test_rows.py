"""What policies share that answer row by row: their memories, and their task."""

import numpy as np
import pytest

from lagros_envs.tasks.spacecraft.scenarios import PRESETS
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_policies.policy import row_memories
from lagros_policies.tasks.spacecraft.setup import task_and_preset


def test_a_new_state_remembers_nothing():
    assert row_memories(None, None, 3, "rows", str) == [None] * 3
    assert row_memories(None, np.array([True, False]), 2, "rows", str) == [None] * 2


def test_only_the_rows_that_start_forget():
    state = ["a", "b", "c"]
    assert row_memories(state, None, 3, "rows", str) == state
    assert row_memories(state, np.array([False, True, False]), 3, "rows", str) == ["a", None, "c"]
    assert state == ["a", "b", "c"]


@pytest.mark.parametrize(
    ("state", "starts"), [(["a"], None), (None, np.zeros(3, bool)), (["a"], np.zeros(1, bool))]
)
def test_memories_starts_and_rows_are_equally_many(state, starts):
    with pytest.raises(ValueError, match="2 are observed"):
        row_memories(state, starts, 2, "rows", str)


def test_the_task_is_the_papers_and_the_preset_has_the_agents_asked_for():
    settings, preset = task_and_preset(None, "crossing", 4)
    assert settings == SpacecraftSettings()
    assert preset == PRESETS["crossing"].for_agents(4)
    assert preset.agents == 4
    own = SpacecraftSettings(horizon=30.0)
    settings, preset = task_and_preset(own, preset, None)
    assert settings is own
    assert preset.agents == 4
    with pytest.raises(ValueError, match="preset='none such'"):
        task_and_preset(None, "none such", None)


@pytest.mark.parametrize("starts", ["x", ["yes", "no"], [None, None], np.array([1j, 0])])
def test_a_start_is_true_or_false(starts):
    with pytest.raises(ValueError, match=r"episode_start=.* must be True or False"):
        row_memories([None, None], starts, 2, "episodes", str)


@pytest.mark.parametrize("starts", [[True, False], np.array([[1.0], [0.0]], np.float32), (1, 0)])
def test_a_start_may_be_a_number(starts):
    assert row_memories(["a", "b"], starts, 2, "episodes", str) == [None, "b"]

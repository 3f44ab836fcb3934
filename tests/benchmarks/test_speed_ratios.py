"""The ratios against peers: what they say, and how a peer elsewhere is asked."""

import sys

import gymnasium as gym
import numpy as np
import pytest
from speed import learner, ratios, report, run, timing

# For a shell, then for the Python that it runs: the path of Python may hold a space.
STUB = """#!/bin/sh
'''exec' "{python}" "$0" "$@"
' '''
import json, sys
print(json.dumps({{"version": "9.9 of " + sys.argv[2], "rounds": ["step"]}}), flush=True)
for number, line in enumerate(sys.stdin):
    print({answer}, flush=True)
"""


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """Let an interpreter of another environment be this script."""

    def install(answer):
        script = tmp_path / "python"
        script.write_text(STUB.format(python=sys.executable, answer=answer))
        script.chmod(0o755)
        monkeypatch.setenv("LAGROS_SPEED_VMAS", str(script))

    return install


def times(*seconds):
    return timing.Times(np.array(seconds), [])


def test_a_duel_counts_how_often_ours_fits_into_the_peer():
    duel = ratios.Duel(
        "work",
        "a peer",
        times(6.0, 1.0, 8.0),
        {"default": times(2.0, 2.0, 2.0), "compiled": times(1.0, 1.0, 1.0)},
        4.0,
    )
    assert duel.speed("default") == 3.0
    assert [target.met for target in duel.targets()] == [False, True]
    rows = duel.rows()
    assert [row.median_s for row in rows] == [6.0, 2.0, 1.0]
    assert rows[1].remark == "3 ×"


def test_a_quoted_peer_is_said_to_be_quoted(monkeypatch):
    monkeypatch.delenv("LAGROS_SPEED_VMAS", raising=False)
    with ratios.Peer("vmas") as peer:
        assert peer.candidate("step") == {}
        theirs = peer.times("step", {})
    duel = ratios.Duel("work", peer.name, theirs, {"default": times(theirs / 12.0)}, 10.0)
    assert duel.speed("default") == pytest.approx(12.0)
    assert duel.rows()[0].remark == "quoted"


def test_a_peer_elsewhere_takes_turns(elsewhere):
    elsewhere("0.25 + number")
    with ratios.Peer("vmas") as peer:
        measured = timing.interleave(peer.candidate("step"), rounds=3, warm_up=False)
        assert peer.version == "9.9 of vmas"
        found = peer.times("step", measured)
    np.testing.assert_array_equal(found.seconds, [0.25, 1.25, 2.25])


def test_a_peer_that_ends_is_named(elsewhere):
    elsewhere("sys.exit()")
    with (
        ratios.Peer("vmas") as peer,
        pytest.raises(RuntimeError, match="process of vmas ended"),
    ):
        peer.candidate("step")["vmas"](0)


def test_each_choice_of_topics_has_its_file():
    assert run._published([]).name == "speed.json"
    assert run._published(["ratios"]).name == "speed_ratios.json"
    assert run._published(["learner"]).name == "speed_learner.json"
    assert run._published(["sdp", "ratios"]) is None


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_the_ratios_are_measured(monkeypatch):
    for name in ("VMAS", "SAFE_CONTROL_GYM"):
        monkeypatch.delenv(f"LAGROS_SPEED_{name}", raising=False)
    scale = timing.Scale(rounds=2, calls=2, worlds=3, designs=1, tracked_episodes=1)
    (section,) = ratios.sections(scale)
    assert isinstance(section, report.Section)
    assert len({target.what for target in section.targets}) == len(section.targets) >= 8
    assert all(np.isfinite(target.measured) for target in section.targets)


@pytest.mark.filterwarnings("ignore")
def test_what_a_learner_meets_is_measured(monkeypatch):
    monkeypatch.delenv("LAGROS_SPEED_VMAS", raising=False)
    monkeypatch.setattr(learner, "_ROLLOUT", 2)
    scale = timing.Scale(rounds=2, calls=2, worlds=3, designs=1)
    (section,) = learner.sections(scale)
    assert any("vmas not installed" in row.remark for row in section.rows)
    assert all(np.isfinite(target.measured) for target in section.targets)
    (share,) = [target for target in section.targets if not target.at_least]
    assert 0.0 < share.measured < 1.0


def test_random_actions_end_episodes_and_resets_are_counted():
    env = gym.make_vec("lagros/CartPole-v0", num_envs=4, compiled=False)
    ends = []
    step = env.step
    env.step = lambda actions: ends.append(step(actions)[2].sum())
    assert learner.stepping_worlds(env, 60)(0) > 0.0
    assert sum(ends) > 10

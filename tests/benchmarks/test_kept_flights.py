"""Flights that a study keeps are those of the weights and metrics that lie there now."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from studies import conformal, worst_case

from lagros_benchmarks.evidence import calibration
from lagros_benchmarks.evidence.calibration import EpisodeScores, pretrained_hash
from lagros_benchmarks.worst_case.attack import AttackSettings

FILES = ("cartpole_lagros.safetensors", "cartpole_metric.json", "spacecraft_lagros.safetensors")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of networks in the place of the shipped one, and another to run in."""
    networks = tmp_path / "pretrained"
    networks.mkdir()
    for name in FILES:
        (networks / name).write_bytes(name.encode())
    package = SimpleNamespace(__file__=str(tmp_path / "__init__.py"))
    monkeypatch.setattr(calibration, "lagros_policies", package)
    monkeypatch.chdir(tmp_path)
    return networks


def test_every_bit_of_a_task_s_networks_and_metrics_counts(folder: Path) -> None:
    seen = {pretrained_hash("cartpole")}
    for name in FILES[:2]:
        (folder / name).write_bytes(b"another")
        assert pretrained_hash("cartpole") not in seen
        seen.add(pretrained_hash("cartpole"))
    # Two files that change places are not the same two.
    for first, second in ((b"a", b"b"), (b"b", b"a")):
        (folder / FILES[0]).write_bytes(first)
        (folder / FILES[1]).write_bytes(second)
        assert pretrained_hash("cartpole") not in seen
        seen.add(pretrained_hash("cartpole"))


def test_another_task_and_the_record_of_a_training_do_not_count(folder: Path) -> None:
    before = pretrained_hash("cartpole")
    (folder / FILES[2]).write_bytes(b"another")
    (folder / "cartpole_lagros.json").write_text("{}")
    assert pretrained_hash("cartpole") == before
    assert pretrained_hash("cartpole", 1) != before


def test_a_network_that_changed_is_flown_again(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flown: list[int] = []

    def scores(*_: object) -> EpisodeScores:
        flown.append(1)
        return EpisodeScores({"tube": np.array([1.0, float(len(flown)), np.inf])}, 1, 0.5)

    monkeypatch.setattr(conformal, "single_scores", scores)
    case = {"task": "cartpole", "policy": "lagros", "kind": "uniform", "bound": 0.75}
    first, _ = conformal.scores_of(case, 1, 3, Path("runs"))
    again, _ = conformal.scores_of(case, 1, 3, Path("runs"))
    np.testing.assert_array_equal(first.values["tube"], again.values["tube"])
    assert len(flown) == 1
    (folder / FILES[0]).write_bytes(b"trained again")
    after, _ = conformal.scores_of(case, 1, 3, Path("runs"))
    assert len(flown) == 2
    assert after.values["tube"][1] == 2.0


def test_a_network_or_a_search_that_changed_is_attacked_again(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    attacked: list[AttackSettings] = []

    def attack(settings: AttackSettings) -> SimpleNamespace:
        attacked.append(settings)
        return SimpleNamespace(row={"number": len(attacked)}, cases=None)

    monkeypatch.setattr(worst_case, "run_attack", attack)
    monkeypatch.setattr(worst_case, "save_worst_cases", lambda cases, path: None)
    settings = AttackSettings("cartpole", "lagros", "tube", 0.3, 2)
    numbers = [worst_case.kept(settings, fresh)["number"] for fresh in (False, False, True, False)]
    assert numbers == [1, 1, 2, 2]
    (folder / FILES[1]).write_bytes(b"designed again")
    assert worst_case.kept(settings, False)["number"] == 3
    more = replace(settings, search=replace(settings.search, budget=settings.search.budget + 1))
    assert worst_case.kept(more, False)["number"] == 4
    assert worst_case.kept(settings, False)["number"] == 3

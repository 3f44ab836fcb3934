"""`lagros train --algo c3m` and `--algo missing`: what is kept, filled in and refused."""

import json
import re
from dataclasses import asdict, replace

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from typer.testing import CliRunner

from lagros_benchmarks.commands import train as command
from lagros_benchmarks.commands.cli import app
from lagros_benchmarks.run.files import plain
from lagros_benchmarks.training import c3m
from lagros_benchmarks.training.c3m_run import SCAN, C3mRun
from lagros_benchmarks.training.run import Place
from lagros_envs.registry import task_named
from lagros_policies.c3m import ContractionNetworks
from lagros_policies.learning.c3m import C3mSettings, region_of

TINY = C3mSettings(samples=64, epochs=2, batch=32, width=8, directions=8, checks=32)


def test_a_complete_run_is_only_read_and_another_one_is_refused(tmp_path, monkeypatch):
    place = Place(tmp_path / "run")
    run = C3mRun("segway", TINY, SCAN[:2], scan_episodes=3, final_episodes=2)
    record = c3m.train(run, place, "a command")
    assert record == json.loads(place.record.read_text())
    assert [row["disturbance"] for row in record["final"]] == ["uniform", "constant"]
    law = ContractionNetworks.load(place.weights)
    assert law.metadata["policy"] == "c3m"
    assert law.scaled.seen == (1, 2, 3)
    assert not list(place.folder.glob("progress*"))
    monkeypatch.setattr(c3m, "fit_c3m", None)
    assert c3m.train(run, place) == record
    with pytest.raises(ValueError, match="holds another run"):
        c3m.train(run.seeded(1), place)


def test_the_candidate_that_flies_best_is_kept(tmp_path, monkeypatch):
    flown = iter(
        [(0.5, 0.5, 1.0), (1.0, 0.5, 3.0), (1.0, 0.5, 2.0), (0.9, 0.9, 0.1), (0.0, 0.0, 9.0)]
    )

    def figures(task, networks, episodes, namespace):
        names = ("success", "strict", "final_distance")
        return [dict(zip(names, next(flown), strict=True))]

    monkeypatch.setattr(c3m, "_flown", figures)
    place = Place(tmp_path / "run")
    record = c3m.train(C3mRun("segway", TINY, enough=1.0), place)
    rates = (0.5, 0.5, 1.0)  # episodes are six seconds long
    tried = [asdict(one) | {"rate": rate} for one, rate in zip(SCAN, rates, strict=True)]
    assert [one["candidate"] for one in record["scan"]] == tried
    assert record["chosen"] == tried[2]
    # The weights and the region are its own: the middle of the box is in the file.
    law = ContractionNetworks.load(place.weights)
    region = region_of(task_named("segway"), 0, met=True)
    middle = np.mean([region.low, region.high], axis=0)
    np.testing.assert_allclose(law.scaled.centre, middle, rtol=1e-6)
    assert record["region"] == plain(asdict(region))


def test_no_other_is_tried_where_the_first_keeps_its_promise(tmp_path):
    run = C3mRun("segway", TINY, enough=0.0, scan_episodes=1, final_episodes=1)
    record = c3m.train(run, Place(tmp_path / "run"))
    assert len(record["scan"]) == 1
    assert record["chosen"] == asdict(SCAN[0]) | {"rate": 0.5}


def test_a_candidate_is_as_fast_as_episodes_are_long():
    run = C3mRun("segway", TINY)
    assert run.settings_of(SCAN[0], 600.0) == replace(TINY, largest=10.0)
    assert run.settings_of(SCAN[1], 6.0) == replace(TINY, rate=0.5, largest=10.0)
    assert run.settings_of(SCAN[2], 600.0) == replace(TINY, rate=0.01, largest=100.0)


def test_what_is_missing_is_trained_and_put_in_its_place(tmp_path, monkeypatch):
    class Kept(type(task_named("pvtol"))):
        weights = tmp_path / "weights"
        name, title = "kept-pvtol", "KeptPvtol"

    Kept.weights.mkdir()
    (Kept.weights / "kept-pvtol_sac.safetensors").write_bytes(b"one")
    task = Kept()
    for module in ("lagros_envs.registry", "lagros_benchmarks.training.course"):
        monkeypatch.setattr(f"{module}.find_task", lambda name: task)
    monkeypatch.setattr("lagros_benchmarks.training.settings.find_task", lambda name: task)
    asked = []

    def trained(run, place, *others):
        asked.append(getattr(run, "label", "?"))
        place.folder.mkdir(parents=True, exist_ok=True)
        place.weights.write_bytes(b"weights of " + run.label.encode())
        place.record.write_text("{}")
        return {"final": [], "training": {"task": "kept-pvtol"}}

    monkeypatch.setattr(c3m, "train", trained)
    monkeypatch.setattr("lagros_benchmarks.training.run.train", trained)
    monkeypatch.setattr("lagros_benchmarks.training.table.final_table", lambda record: "")
    arguments = ["train", "kept-pvtol", "--algo", "missing", "--out", str(tmp_path / "runs")]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert asked == ["c3m", "ppo"]
    for name in asked:
        path = Kept.weights / f"kept-pvtol_{name}.safetensors"
        assert path.read_bytes() == b"weights of " + name.encode()
        assert path.with_suffix(".json").is_file()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("pvtol", "--algo", "c3m", "--segments", "2"), "--segments is for reinforcement"),
        (("pvtol", "--algo", "c3m", "--json", "curves.json"), "--json is for reinforcement"),
        (("spacecraft", "--algo", "missing"), "--algo missing is for one body"),
        (("pvtol", "--algo", "missing", "--seed", "0,1"), "--algo missing is for one body"),
        (("spacecraft", "--algo", "c3m"), "--algo c3m is for one body"),
    ],
)
def test_what_makes_no_sense_is_refused(arguments, message, monkeypatch):
    monkeypatch.setattr(command, "_train_one", None)
    result = CliRunner().invoke(app, ["train", *arguments])
    assert result.exit_code == 2
    assert message in re.sub(r"\s+", " ", result.output)

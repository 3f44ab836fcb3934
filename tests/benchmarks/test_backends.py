"""Chunks of work on every backend: the same results, and a dead worker costs its chunk only."""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import sys

import numpy as np
import pytest
from typer.testing import CliRunner

from lagros_benchmarks import cli
from lagros_benchmarks.files import plain
from lagros_benchmarks.records import summarise
from lagros_benchmarks.reproduce import ReproduceSettings, _claim
from lagros_benchmarks.runner import run_benchmark
from lagros_benchmarks.settings import BenchmarkSettings
from lagros_policies.backends import ATTEMPTS, Backend, BackendError, each, running
from lagros_policies.contraction import load_metric
from lagros_policies.imitation.dataset import ExpertDataSettings, generate
from lagros_policies.imitation.spacecraft_flights import FlightSettings, fly_expert
from tests.benchmarks import fakes, fragile

DASK = Backend("dask")
# Each process of a cluster imports everything anew, which takes a while where cores are few.
pytestmark = pytest.mark.timeout(900)


@pytest.fixture(scope="module", params=["ray", "dask"])
def cluster(request):
    """A running cluster of three worker processes, named by its address, and connected."""
    if request.param == "ray":
        pytest.importorskip("ray", reason="the extra `ray` is not installed")
        from ray.cluster_utils import Cluster

        place = started(Cluster)
        backend, close = Backend("ray", place.address), place.shutdown
    else:
        distributed = pytest.importorskip("distributed", reason="the extra `dask` is not installed")
        place = distributed.LocalCluster(
            n_workers=3, threads_per_worker=1, dashboard_address=":0", silence_logs=50
        )
        backend, close = Backend("dask", place.scheduler_address), place.close
    with running(backend, 1):
        yield backend
    close()


def started(cluster):
    """Return a cluster of Ray, begun again where the machine is too busy for its time limits."""
    head = {"num_cpus": 3, "include_dashboard": False}
    for attempt in range(ATTEMPTS):
        try:
            return cluster(initialize_head=True, head_node_args=head)
        except Exception:
            if attempt == ATTEMPTS - 1:
                raise
    return None


def test_a_wrong_backend_is_refused():
    with pytest.raises(ValueError, match=r"unknown backend 'spark'. Valid: loky, ray, dask"):
        Backend("spark")
    with pytest.raises(ValueError, match="leave it out for loky"):
        Backend("loky", "tcp://host:8786")
    for command in ("bench", "reproduce"):
        result = CliRunner().invoke(cli.app, [command, "cartpole", "--backend", "spark"])
        assert (result.exit_code, "unknown backend 'spark'" in result.stderr) == (2, True)


def test_a_run_goes_on_with_another_backend(tmp_path):
    for backend in (Backend(), DASK):
        _claim(tmp_path, ReproduceSettings(backend=backend))
    with pytest.raises(ValueError, match="other settings"):
        _claim(tmp_path, ReproduceSettings(data=ExpertDataSettings(seed=1)))


@pytest.mark.parametrize(("name", "module"), [("ray", "ray"), ("dask", "distributed")])
def test_a_backend_that_is_not_installed_is_named_with_its_extra(name, module, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(BackendError, match=rf"pip install 'lagros\[{name}\]'"):
        list(each(str, [1, 2], 1, Backend(name)))
    result = CliRunner().invoke(
        cli.app, ["bench", "cartpole", "--policies", "lqr", "--backend", name]
    )
    assert result.exit_code == 1
    assert f"lagros[{name}]" in result.stderr


def test_ray_that_does_not_start_is_tried_again_and_then_reported(monkeypatch):
    ray = pytest.importorskip("ray", reason="the extra `ray` is not installed")
    tried = []

    def time_out(**settings):
        tried.append(settings["address"])
        raise Exception("The current node timed out during startup.")

    monkeypatch.setattr(ray, "init", time_out)
    with pytest.raises(BackendError, match=r"timed out during startup.*ray start --head"):
        list(each(str, [1, 2], 2, Backend("ray")))
    assert tried == ["local"] * ATTEMPTS


def test_nothing_to_do_starts_nothing(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert list(each(str, [], 3, Backend("ray"))) == []


def test_in_this_process_and_in_others_the_same():
    here = dict(each(fragile.refuse, [1, 3, 5]))
    assert here == {0: 1, 1: 3, 2: 5}
    assert dict(each(fragile.refuse, [1, 3, 5], 2)) == here
    for jobs in (1, 2):
        with pytest.raises(ZeroDivisionError, match="number 2"):
            list(each(fragile.refuse, [1, 2, 3, 4], jobs))


def test_chunks_share_a_process_of_dask_one_at_a_time():
    distributed = pytest.importorskip("distributed", reason="the extra `dask` is not installed")
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=4, processes=False, dashboard_address=":0"
        ) as place,
        distributed.Client(place),
    ):
        spans = sorted(span for _, span in each(fragile.lasting, range(8), 1, DASK))
    assert all(end <= begin for (_, end), (begin, _) in itertools.pairwise(spans))


@pytest.mark.slow
def test_a_worker_of_this_machine_that_dies_costs_what_the_pool_was_doing(tmp_path):
    work, lost = fragile.Fragile(tmp_path, deadly=3), []
    out = dict(each(work, range(8), 2, on_lost=lost.append))
    assert out == {number: number**2 for number in range(8)}
    # joblib ends the pool with its worker: chunks of the other one, and results that it had not
    # taken, are lost as well.
    begun = work.begun()
    assert len(begun[3]) == 2
    assert sum(lost) == sum(map(len, begun.values())) - 8


@pytest.mark.slow
def test_a_worker_of_a_cluster_that_dies_costs_its_chunk_only(cluster, tmp_path):
    work, lost = fragile.Fragile(tmp_path, deadly=4), []
    out = dict(each(work, range(12), 1, cluster, lost.append))
    assert out == {number: number**2 for number in range(12)}
    begun = work.begun()
    again = [number for number, processes in begun.items() if len(processes) > 1]
    # On Dask also what the dead one had done and not yet handed over; nothing of the others.
    assert again == [4] if cluster.name == "ray" else 4 in again
    assert {begun[number][0] for number in again} == {begun[4][0]}
    assert all(len(processes) <= 2 for processes in begun.values())
    assert sum(lost) == len(again)


@pytest.mark.slow
def test_a_chunk_that_kills_every_worker_ends_the_run(cluster, tmp_path):
    for backend in (cluster, Backend()):
        folder = tmp_path / backend.name
        folder.mkdir()
        work = fragile.Fragile(folder, deadly=1, deaths=100)
        with pytest.raises(BackendError, match=f"lost its worker {ATTEMPTS} times"):
            list(each(work, range(2), 2, backend))
        # Dask counts the workers that it was meant for; on loky, other chunks may come to an end.
        tries = len(work.begun()[1])
        assert tries == ATTEMPTS if backend.name == "ray" else 1 < tries <= ATTEMPTS + 1


@pytest.mark.slow
def test_what_the_work_raises_is_raised_as_it_is(cluster):
    with pytest.raises(ZeroDivisionError, match=r"^number 2$"):
        list(each(fragile.refuse, [1, 2, 3, 4], 1, cluster))


def without_timings(rows):
    """Return the rows as they are written, without times and without what the run ran on."""
    other = ("step_time", "forward_time", "deadline", "threads", "command")
    return [
        {name: value for name, value in row.items() if not name.startswith(other)}
        for row in json.loads(json.dumps(plain(rows)))
    ]


@pytest.mark.slow
def test_a_benchmark_in_which_a_worker_dies_has_the_rows_of_the_serial_one(
    cluster, tmp_path, caplog
):
    serial = BenchmarkSettings(policies=("steady", "raising", "drawing"), episodes=12, chunk=2)
    expected = run_benchmark(serial, fakes.TOOLBOX)
    make = fragile.MakeFragile(tmp_path, os.getpid())
    toolbox = dataclasses.replace(fakes.TOOLBOX, make_policy=make)
    run = run_benchmark(dataclasses.replace(serial, backend=cluster), toolbox)
    assert [path.name for path in tmp_path.iterdir()] == ["death_0"]
    assert "chunk(s) of work are run again" in caplog.text
    assert without_timings(summarise(run)) == without_timings(summarise(expected))
    assert run.episodes == expected.episodes


@pytest.mark.slow
def test_lagros_bench_writes_the_figures_of_the_serial_run(cluster, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = ["bench", "cartpole", "--policies", "lagros,learned,lqr", "--episodes", "30"]
    place = ["--backend", cluster.name, "--address", cluster.address]
    for name, options in (("serial", []), (cluster.name, place)):
        result = CliRunner().invoke(cli.app, [*command, *options, "--json", f"{name}.json"])
        assert result.exit_code == 0, result.output
    read = [
        without_timings(json.loads((tmp_path / f"{name}.json").read_text()))
        for name in ("serial", cluster.name)
    ]
    assert read[0] == read[1]


@pytest.mark.slow
def test_expert_data_are_the_same_bytes(cluster, tmp_path):
    settings = ExpertDataSettings(plans=8, samples=400, shards=4)
    for name, backend in (("serial", Backend()), (cluster.name, cluster)):
        generate(tmp_path / name, load_metric(), settings, backend=backend)
    for index in range(4):
        one, two = (
            np.load(tmp_path / name / f"shard_{index:04d}.npz") for name in ("serial", cluster.name)
        )
        with one, two:
            assert one.files == two.files
            for name in one.files:
                np.testing.assert_array_equal(one[name], two[name])


@pytest.mark.slow
def test_expert_flights_are_the_same(cluster, tmp_path):
    settings = FlightSettings(worlds=2, worlds_per_shard=1, agents=(2,), sample_every=50, seed=3)
    one, two = (
        fly_expert(tmp_path / backend.name, settings, backend=backend)
        for backend in (Backend(), cluster)
    )
    for name in ("observation", "acceleration", "world"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ray", "dask"])
def test_without_an_address_workers_are_started_and_stopped(name):
    module = {"ray": "ray", "dask": "distributed"}[name]
    pytest.importorskip(module, reason=f"the extra `{name}` is not installed")
    with running(Backend(name), 2):
        out = dict(each(fragile.refuse, range(5, 9), 2, Backend(name)))
    assert out == dict(enumerate(range(5, 9)))


@pytest.mark.slow
@pytest.mark.parametrize("address", ["127.0.0.1:1", "ray://127.0.0.1:1", "nowhere:x"])
def test_an_address_without_a_cluster_is_named(address):
    for name, module in (("ray", "ray"), ("dask", "distributed")):
        pytest.importorskip(module, reason=f"the extra `{name}` is not installed")
        if name == "ray" or "//" not in address:
            with pytest.raises(BackendError, match=f"no {name.title()} .* answers at '{address}'"):
                list(each(str, [1], 1, Backend(name, address)))

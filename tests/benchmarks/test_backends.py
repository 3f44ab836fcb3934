"""Chunks of work on every backend: the same results, and a dead worker costs its chunk only."""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import joblib
import numpy as np
import pytest
from typer.testing import CliRunner

from lagros_benchmarks.commands import cli
from lagros_benchmarks.report.records import summarise
from lagros_benchmarks.run.files import plain
from lagros_benchmarks.run.reproduce import ReproduceSettings
from lagros_benchmarks.run.reproduction import reproduce
from lagros_benchmarks.run.runner import run_benchmark
from lagros_benchmarks.run.settings import BenchmarkSettings
from lagros_envs.registry import task_named
from lagros_policies.backends import (
    ATTEMPTS,
    LOKY,
    Backend,
    BackendError,
    base,
    dask,
    each,
    running,
)
from lagros_policies.backends import loky as processes
from lagros_policies.expert import metric_of
from lagros_policies.learning.dataset import ExpertDataSettings, generate
from lagros_policies.tasks.spacecraft.flights import FlightSettings, fly_expert
from tests.benchmarks import fakes, fragile

DASK = Backend("dask")
# Each process of a cluster imports everything anew, which takes a while where cores are few.
pytestmark = pytest.mark.timeout(900)
JOBS = 3


@pytest.fixture(scope="module", params=["loky", "ray", "dask"])
def place(request):
    """Three worker processes: of this machine, or of a running cluster that is connected."""
    if request.param == "loky":
        yield LOKY
        return
    if request.param == "ray":
        pytest.importorskip("ray", reason="the extra `ray` is not installed")
        from ray.cluster_utils import Cluster

        cluster = started(Cluster)
        backend, close = Backend("ray", cluster.address), cluster.shutdown
    else:
        distributed = pytest.importorskip("distributed", reason="the extra `dask` is not installed")
        cluster = distributed.LocalCluster(
            n_workers=3, threads_per_worker=1, dashboard_address=":0", silence_logs=50
        )
        backend, close = Backend("dask", cluster.scheduler_address), cluster.close
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


def test_a_run_goes_on_with_another_backend(tmp_path, monkeypatch):
    monkeypatch.setattr(ReproduceSettings, "make", lambda *_: None)
    for backend in (LOKY, DASK):
        assert reproduce(tmp_path, ReproduceSettings(backend=backend)).backend == backend
    with pytest.raises(ValueError, match="other settings"):
        reproduce(tmp_path, ReproduceSettings(data=ExpertDataSettings(seed=1)))


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

    # Ray may be connected already, for other tests.
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray, "shutdown", lambda: None)
    monkeypatch.setattr(ray, "init", time_out)
    with pytest.raises(BackendError, match=r"timed out during startup.*ray start --head"):
        list(each(str, [1, 2], 2, Backend("ray")))
    assert tried == ["local"] * ATTEMPTS


@pytest.mark.slow
def test_a_scheduler_that_goes_ends_the_run():
    distributed = pytest.importorskip("distributed", reason="the extra `dask` is not installed")
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, processes=False, dashboard_address=":0"
        ) as cluster,
        distributed.Client(cluster),
    ):
        stream = each(fragile.lasting, range(200), 1, DASK)
        next(stream)
        cluster.close()
        with pytest.raises(BackendError, match="Dask gave a chunk of work up"):
            list(stream)


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


def wait_until(condition, seconds=120.0):
    """Look again and again, for the machine may be busy."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def is_gone(process):
    """Return whether a process has ended; one that nobody has waited for yet has."""
    found = subprocess.run(
        ["ps", "-o", "stat=", "-p", str(process)], capture_output=True, text=True, check=False
    )
    return found.stdout.strip()[:1] in ("", "Z")


def test_workers_of_this_machine_stay_for_the_next_call():
    first, second = (set(dict(each(fragile.process, range(6), 2)).values()) for _ in range(2))
    assert first == second
    assert len(first) == 2
    assert os.getpid() not in first
    with pytest.raises(ZeroDivisionError):
        list(each(fragile.refuse, [2], 2))
    assert set(dict(each(fragile.process, range(6), 2)).values()) == first


def test_a_worker_that_waited_long_is_left_to_end(monkeypatch):
    first = set(dict(each(fragile.process, range(6), 2)).values())
    monkeypatch.setattr(processes, "_STALE", 0.0)
    second = set(dict(each(fragile.process, range(6), 2)).values())
    assert not first & second
    wait_until(lambda: all(map(is_gone, first)))


def test_a_worker_that_dies_while_it_waits_costs_nothing():
    lost = []
    first = set(dict(each(fragile.process, range(6), 2)).values())
    for process in first:
        os.kill(process, signal.SIGKILL)
    wait_until(lambda: all(map(is_gone, first)))
    second = set(dict(each(fragile.process, range(6), 2, on_lost=lost.append)).values())
    assert (len(second), first & second, lost) == (2, set(), [])


def test_workers_have_their_share_of_the_processors_as_joblib_gives_it(monkeypatch):
    for name in processes.THREAD_LIMITS:
        monkeypatch.delenv(name, raising=False)
    expected = joblib.Parallel(2)(joblib.delayed(fragile.limits)(number) for number in range(2))
    assert list(dict(each(fragile.limits, range(2), 2)).values()) == expected
    assert set(expected[0].values()) == {str(max(joblib.cpu_count() // 2, 1))}
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    ((_, found),) = each(fragile.limits, [0], 2)
    assert found == {**expected[0], "OMP_NUM_THREADS": "3"}


@pytest.mark.parametrize("how", ["closed", "interrupted", "raised"])
def test_who_stops_asking_leaves_no_chunk_running(how, tmp_path):
    work = fragile.Endless(tmp_path)
    stream = each(work, [2, 1 if how == "raised" else 3, 0], 3)
    assert next(stream) == (2, 0)
    wait_until(lambda: len(work.log()) == 3)
    if how == "closed":
        stream.close()
    elif how == "interrupted":
        with pytest.raises(KeyboardInterrupt):
            stream.throw(KeyboardInterrupt())
    else:
        with pytest.raises(ZeroDivisionError):
            next(stream)
    busy = [process for number, process in work.log() if number > 1]
    assert all(map(is_gone, busy))
    # The others wait for the next call.
    idle = {process for number, process in work.log() if number <= 1}
    assert idle <= set(dict(each(fragile.process, range(9), 3)).values())


@pytest.mark.parametrize("kill", [signal.SIGINT, signal.SIGKILL])
def test_workers_end_with_the_one_that_asked(kill, tmp_path):
    # What a shell starts in the background ignores Ctrl-C, and so does what that starts.
    script = f"""
import pathlib, signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from lagros_policies.backends import each
from tests.benchmarks.fragile import Fragile
work = Fragile(pathlib.Path({str(tmp_path)!r}), lasting=600.0)
list(each(work, range(100), 2))
"""
    run = subprocess.Popen(
        [sys.executable, "-c", script],
        cwd=Path(__file__).parents[2],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    log = fragile.Fragile(tmp_path).log
    try:
        wait_until(lambda: len(log()) >= 2)
        # The terminal's Ctrl-C goes to all processes of a group.
        os.killpg(run.pid, kill) if kill == signal.SIGINT else run.kill()
        trouble = run.communicate(timeout=60)[1]
    finally:
        run.kill()
    assert run.returncode != 0
    assert trouble.count("Traceback") == (kill == signal.SIGINT)
    wait_until(lambda: all(is_gone(process) for _, process in log()))


@pytest.mark.parametrize("work", [fragile.leave, fragile.close])
def test_work_that_asks_to_exit_ends_neither_its_worker_nor_the_run(work):
    with pytest.raises(RuntimeError, match=r"SystemExit: 0|GeneratorExit"):
        list(each(work, [1], 2))
    assert dict(each(fragile.process, [1, 2], 2))


def test_what_work_prints_is_no_output_of_the_run(capfd, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "5")  # so that no idle worker is fit
    list(each(fragile.say, [1, 2], 2))
    out, trouble = capfd.readouterr()
    assert (out, trouble.count("said")) == ("", 2)


def test_workers_search_no_module_in_the_folder_that_they_are_started_in(tmp_path, monkeypatch):
    for name in ("numpy", "joblib", "signal", "fragile_only"):
        (tmp_path / f"{name}.py").write_text("raise SystemError('taken from the folder')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OMP_NUM_THREADS", "7")  # so that no idle worker is fit
    assert set(dict(each(fragile.safe_path, [1, 2], 2)).values()) == {None}
    assert "PYTHONSAFEPATH" not in os.environ


@pytest.mark.slow
def test_a_cluster_that_dask_starts_here_listens_to_this_machine_alone():
    pytest.importorskip("distributed", reason="the extra `dask` is not installed")
    psutil = pytest.importorskip("psutil")
    with running(DASK, 1):
        us = psutil.Process()
        ends = [
            connection.laddr.ip
            for process in (us, *us.children(recursive=True))
            for connection in process.net_connections("inet")
            if connection.status == psutil.CONN_LISTEN
        ]
    assert set(ends) == {"127.0.0.1"}


def test_a_worker_of_this_machine_that_dies_in_the_middle_of_its_answer(tmp_path):
    lost = []
    out = dict(each(fragile.Tearing(tmp_path), range(5), 2, on_lost=lost.append))
    assert out == {number: bytes([number]) * 1000 for number in range(5)}
    assert lost == [1]


def test_an_exception_that_cannot_be_sent_is_told():
    with pytest.raises(RuntimeError, match=r"^AwkwardError: 1 is odd$") as caught:
        list(each(fragile.be_awkward, [1], 2))
    assert "in be_awkward" in str(caught.value.__cause__)


@pytest.mark.slow
def test_a_worker_that_dies_costs_its_chunk_only(place, tmp_path):
    work, lost = fragile.Fragile(tmp_path, deadly=4), []
    out = dict(each(work, range(12), JOBS, place, lost.append))
    assert out == {number: number**2 for number in range(12)}
    begun = work.begun()
    assert [number for number, processes in begun.items() if len(processes) > 1] == [4]
    assert len(set(begun[4])) == 2
    assert sum(lost) == 1


@pytest.mark.slow
def test_what_is_finished_and_not_yet_asked_for_outlives_its_worker(place, tmp_path):
    # So many bytes as Ray and Dask do not carry along with their messages.
    work, lost = fragile.Fragile(tmp_path, lasting=0.4, bulk=500_000), []
    stream = each(work, range(20), JOBS, place, lost.append)
    out = dict([next(stream)])
    # Processes of this machine stop here for whoever asks, each with one result in its hands.
    enough = JOBS + 1 if place == LOKY else 14
    wait_until(lambda: len(work.log()) >= enough)
    time.sleep(0.1)
    _, killed = work.log()[-1]
    os.kill(killed, signal.SIGKILL)
    out.update(stream)
    assert out == {number: bytes([number]) * work.bulk for number in range(20)}
    last = [number for number, process in work.log() if process == killed][-1]
    again = [number for number, processes in work.begun().items() if len(processes) > 1]
    assert again in ([], [last])
    assert len(again) <= sum(lost) <= 1


@pytest.mark.slow
@pytest.mark.parametrize("place", ["dask"], indirect=True)
def test_a_worker_of_dask_keeps_no_result_while_it_works(place, tmp_path, monkeypatch):
    take, may_take = dask._take, threading.Event()
    monkeypatch.setattr(dask, "_take", lambda *both: may_take.wait() and take(*both))
    work, out = fragile.Fragile(tmp_path, lasting=0.0), {}
    asking = threading.Thread(target=lambda: out.update(each(work, range(9), JOBS, place)))
    asking.start()
    try:
        wait_until(lambda: len(work.log()) >= JOBS)
        time.sleep(0.5)
        assert len(work.log()) == JOBS
    finally:
        may_take.set()
        asking.join()
    assert out == {number: number**2 for number in range(9)}


@pytest.mark.slow
def test_a_chunk_that_kills_every_worker_ends_the_run(place, tmp_path):
    work = fragile.Fragile(tmp_path, deadly=1, deaths=100)
    with pytest.raises(BackendError, match=f"lost its worker {ATTEMPTS} times"):
        list(each(work, range(2), JOBS, place))
    # Dask counts the workers that it was meant for.
    tries = len(work.begun()[1])
    assert 1 < tries <= ATTEMPTS if place.name == "dask" else tries == ATTEMPTS


@pytest.mark.slow
def test_what_the_work_raises_is_raised_as_it_is(place):
    with pytest.raises(ZeroDivisionError, match=r"^number 2$"):
        list(each(fragile.refuse, [1, 2, 3, 4], JOBS, place))


def without_timings(rows):
    """Return the rows as they are written, without times and without what the run ran on."""
    other = ("step_time", "forward_time", "deadline", "threads", "timing_raised", "command")
    return [
        {name: value for name, value in row.items() if not name.startswith(other)}
        for row in json.loads(json.dumps(plain(rows)))
    ]


@pytest.mark.slow
def test_a_benchmark_in_which_a_worker_dies_has_the_rows_of_the_serial_one(place, tmp_path, caplog):
    serial = BenchmarkSettings(policies=("steady", "raising", "drawing"), episodes=12, chunk=2)
    expected = run_benchmark(serial, fakes.TOOLBOX)
    make = fragile.MakeFragile(tmp_path, os.getpid())
    toolbox = dataclasses.replace(fakes.TOOLBOX, make_policy=make)
    run = run_benchmark(dataclasses.replace(serial, backend=place, jobs=2), toolbox)
    assert [path.name for path in tmp_path.iterdir()] == ["death_0"]
    assert "chunk(s) of work are run again" in caplog.text
    rows = summarise(run)
    assert without_timings(rows) == without_timings(summarise(expected))
    assert {row["threads"]["backend"] for row in rows} == {place.name}
    assert run.episodes == expected.episodes


@pytest.mark.slow
def test_lagros_bench_writes_the_figures_of_the_serial_run(place, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = ["bench", "cartpole", "--policies", "lagros,learned,lqr", "--episodes", "30"]
    parallel = ["--backend", place.name, "--jobs", "2"]
    if place.address is not None:
        parallel += ["--address", place.address]
    for name, options in (("serial", []), ("parallel", parallel)):
        result = CliRunner().invoke(cli.app, [*command, *options, "--json", f"{name}.json"])
        assert result.exit_code == 0, result.output
    read = [
        without_timings(json.loads((tmp_path / f"{name}.json").read_text()))
        for name in ("serial", "parallel")
    ]
    assert read[0] == read[1]


@pytest.mark.slow
def test_expert_data_are_the_same_bytes(place, tmp_path):
    settings = ExpertDataSettings(plans=8, samples=400, shards=4)
    for name, jobs, backend in (("serial", 1, LOKY), ("parallel", 2, place)):
        metric = metric_of(task_named("cartpole"))
        generate(tmp_path / name, metric, settings, jobs=jobs, backend=backend)
    for index in range(4):
        one, two = (
            np.load(tmp_path / name / f"shard_{index:04d}.npz") for name in ("serial", "parallel")
        )
        with one, two:
            assert one.files == two.files
            for name in one.files:
                np.testing.assert_array_equal(one[name], two[name])


@pytest.mark.slow
def test_expert_flights_are_the_same(place, tmp_path):
    settings = FlightSettings(worlds=2, worlds_per_shard=1, agents=(2,), sample_every=50, seed=3)
    one, two = (
        fly_expert(tmp_path / name, settings, jobs=jobs, backend=backend)
        for name, jobs, backend in (("serial", 1, LOKY), ("parallel", 2, place))
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


@pytest.fixture(scope="module")
def mute():
    """The port of something that lets connect and says nothing, as a server of web pages does."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield listening.getsockname()[1]


@pytest.mark.parametrize(
    ("name", "address", "why"),
    [
        ("ray", "127.0.0.1:1", "refused"),
        ("ray", "ray://127.0.0.1:1", "refused"),
        ("ray", "nowhere:x", "must be host:port"),
        ("ray", "127.0.0.1:MUTE", "something else"),
        ("dask", "127.0.0.1:1", "refused"),
        ("dask", "tcp://127.0.0.1:1", "refused"),
        ("dask", "tls://127.0.0.1:1", "refused"),
        ("dask", "nowhere:x", "must be host:port"),
        ("dask", "auto", "must be host:port"),
        ("dask", "carrier-pigeon://127.0.0.1:1", "unknown address scheme"),
        ("dask", "127.0.0.1:MUTE", "something else"),
    ],
)
def test_an_address_without_a_cluster_is_named_at_once(name, address, why, mute, monkeypatch):
    # Dask would go on asking for 30 s, Ray for minutes: neither is asked.
    disconnected(name, monkeypatch, refuse_to_ask)
    monkeypatch.setattr(base, "PATIENCE", 0.3)
    address = address.replace("MUTE", str(mute))
    wanted = rf"no {name.title()} .* answers at '{address}' \(.*{why}.*leave the address out"
    with pytest.raises(BackendError, match=wanted):
        list(each(str, [1], 1, Backend(name, address)))


def disconnected(name, monkeypatch, connect):
    """Make a library, which may be connected already for other tests, connect by this function."""
    module = {"ray": "ray", "dask": "distributed"}[name]
    found = pytest.importorskip(module, reason=f"the extra `{name}` is not installed")
    if name == "ray":
        monkeypatch.setattr(found, "is_initialized", lambda: False)
        monkeypatch.setattr(found, "init", connect)
    else:
        monkeypatch.setattr("lagros_policies.backends.dask._current", lambda *_: None)
        monkeypatch.setattr(found, "Client", connect)


def refuse_to_ask(address, **_):
    if "pigeon" in address:
        raise ValueError("unknown address scheme")
    raise AssertionError("asked")


@pytest.mark.parametrize("name", ["ray", "dask"])
def test_whatever_is_raised_where_no_cluster_answers_is_told(name, monkeypatch):
    """Dask takes the bytes of another service for the length of a message, of exabytes."""

    def connect(address, **_):
        raise MemoryError("3.07 EiB")

    def speak(listening):
        with listening.accept()[0] as line:
            line.sendall(b"SSH")

    disconnected(name, monkeypatch, connect)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        speaking = threading.Thread(target=speak, args=(listening,))
        speaking.start()
        address = f"127.0.0.1:{listening.getsockname()[1]}"
        with pytest.raises(BackendError, match=rf"answers at '{address}' \(3.07 EiB\)"):
            list(each(str, [1], 1, Backend(name, address)))
        speaking.join()

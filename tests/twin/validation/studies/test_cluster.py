"""A study on a cluster of Dask: the same results, each worker within its threads, and none lost with a worker."""

import json
import os
import signal
import sys
from collections.abc import Iterator
from importlib.metadata import entry_points
from itertools import pairwise
from pathlib import Path

import cv2
import dask
import pytest
from distributed import LocalCluster

from greenough.instrument.command import GROUP, run
from greenough.instrument.errors import InputError
from greenough.pipeline.jit import dr
from greenough.twin.validation.studies import load_study
from greenough.twin.validation.studies.cluster import on_cluster
from greenough.twin.validation.studies.runs import kept, runs_of
from greenough.twin.validation.studies.study import run_study
from greenough.twin.validation.studies.threads import threads_limited

WORKERS = 2
THREADS = 3  # more than one, and not what a process takes by itself on the usual machine


@pytest.fixture(scope="module")
def cluster(laboratory) -> Iterator[LocalCluster]:
    """Two worker processes, started by nannies that start new ones in place of those that die."""
    patient = {"distributed.comm.timeouts.connect": "180s"}  # on a busy machine Python alone takes long to start
    with (
        dask.config.set(patient),
        LocalCluster(n_workers=WORKERS, threads_per_worker=THREADS, dashboard_address=None) as cluster,
    ):
        yield cluster


def results(folder: Path) -> dict[str, dict]:
    """All results, without what may differ: how long they took."""
    found = {path.name: json.loads(path.read_text()) for path in folder.glob("seed-*.json")}
    return {name: {key: value for key, value in each.items() if key != "seconds"} for name, each in found.items()}


@pytest.mark.slow
def test_the_cluster_finds_what_one_machine_finds_bit_for_bit(cluster, study_file, tmp_path, capsys):
    path = study_file("equal", seeds="6")
    codes = [
        run(["study", str(path), "--out", str(tmp_path / place), "--json", *more], entry_points(group=GROUP))
        for place, more in (("here", []), ("there", ["--scheduler", cluster.scheduler_address]))
    ]
    assert codes == [1, 1]  # seed 4 is refused here and there
    assert results(tmp_path / "here") == results(tmp_path / "there")
    assert len(results(tmp_path / "there")) == 12


def test_a_worker_does_one_run_at_a_time_on_its_own_number_of_threads(cluster, study_file, visits, tmp_path):
    study = load_study(study_file("threads", seeds="12"))
    run_study(study, runs_of(study), tmp_path, on_cluster(cluster.scheduler_address))
    seen = visits("threads")
    assert {tuple(visit.threads) for visit in seen} == {(THREADS, THREADS)}
    for pid in {visit.pid for visit in seen}:
        own = sorted((visit.start, visit.end) for visit in seen if visit.pid == pid)
        assert all(first[1] <= second[0] for first, second in pairwise(own))


@pytest.mark.slow
def test_a_worker_that_dies_takes_no_finished_run_with_it(cluster, study_file, visits, tmp_path):
    study = load_study(study_file("killed-worker", seeds="15"))
    runs = runs_of(study)
    finished: list[dict[str, dict]] = []

    victim = cluster.workers[0].pid

    def advance(steps: float) -> None:
        finished.append(results(tmp_path))
        if len(finished) == 6:
            os.kill(victim, signal.SIGKILL)

    run_study(study, runs, tmp_path, on_cluster(cluster.scheduler_address), advance)
    assert len(finished) == len(results(tmp_path)) == len(runs) == 30
    before = finished[5]
    assert results(tmp_path).items() >= before.items()
    done: dict[tuple[int, float], list[int]] = {}
    for visit in visits("killed-worker"):
        done.setdefault((visit.seed, visit.sd), []).append(visit.pid)
    assert len(done) == 30
    assert all(len(done[each["seed"], float(each["case"])]) == 1 for each in before.values())
    # What the worker was doing is done again, and what it had done without telling; nothing else.
    again = [pids for pids in done.values() if len(pids) > 1]
    assert all(pids[0] == victim != pids[1] and len(pids) == 2 for pids in again)


@pytest.mark.slow
def test_a_run_that_kills_its_workers_is_named_and_done_the_next_time(cluster, study_file, laboratory, tmp_path):
    study = load_study(study_file("deadly", seeds="[5, 6]"))
    runs = runs_of(study)
    (laboratory / "deadly").touch()
    allowed, cluster.scheduler.allowed_failures = cluster.scheduler.allowed_failures, 0
    try:
        with pytest.raises(InputError, match=r"workers died of .* of seed 5.*same command again"):
            run_study(study, runs, tmp_path, on_cluster(cluster.scheduler_address))
    finally:
        cluster.scheduler.allowed_failures = allowed
    assert not all(kept(tmp_path, each) for each in runs)
    run_study(study, runs, tmp_path, on_cluster(cluster.scheduler_address))
    assert all(kept(tmp_path, each) for each in runs)


def test_without_a_scheduler_the_command_says_so(study_file, monkeypatch, capsys):
    path = study_file("nowhere")
    monkeypatch.setattr("greenough.twin.validation.studies.cluster.TIMEOUT_S", 1)
    assert run(["study", str(path), "--scheduler", "tcp://127.0.0.1:9"], entry_points(group=GROUP)) == 2
    assert "no Dask scheduler answers at tcp://127.0.0.1:9" in capsys.readouterr().err


def test_without_dask_the_command_says_how_to_install_it(study_file, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert run(["study", str(study_file("bare")), "--scheduler", "tcp://127.0.0.1:9"], entry_points(group=GROUP)) == 2
    error = capsys.readouterr().err
    assert "pip install 'greenough[cluster]'" in error


def test_threads_are_limited_and_given_back_after_an_error():
    before = dr.thread_count(), cv2.getNumThreads()
    within = []

    def fail() -> None:
        with threads_limited(5):
            within.append((dr.thread_count(), cv2.getNumThreads()))
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert within == [(5, 5)]
    assert (dr.thread_count(), cv2.getNumThreads()) == before

"""A cluster gives what one process gives, a worker that is killed included; what it cannot do is told in one line."""

import os
import signal
from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest

from toolkit.experiment import cluster as clusters
from toolkit.experiment.cluster import Cluster, ClusterError
from toolkit.experiment.units import Outcome, run_unit
from toolkit.experiment.workers import LostUnit, results_of
from toolkit.progress import SILENT

# Asked for by name: to import it takes a twentieth of what all tests take to be found.
pytestmark = pytest.mark.skipif(find_spec("distributed") is None, reason="needs the extra cluster")


@pytest.fixture(scope="module")
def local() -> Iterator[Any]:
    """Two worker processes and their scheduler."""
    import dask
    import distributed

    # How long a worker that is gone is waited for; 30 s otherwise.
    impatient = {"distributed.comm.timeouts.connect": "1s", "distributed.scheduler.allowed-failures": 1}
    with (
        dask.config.set(impatient),
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as started,
    ):
        yield started


def test_a_cluster_of_which_a_worker_is_killed_equals_one_process(local, units):
    requested = units()
    found: dict[int, Outcome] = {}
    with Cluster(local.scheduler_address) as cluster:
        assert cluster.count == 2
        for place, outcome in cluster.results(requested, run_unit, SILENT):
            assert place not in found
            if not found:
                os.kill(local.workers[0].pid, signal.SIGKILL)
            found[place] = outcome
    assert len(found) == len(requested)
    for place, outcome in results_of(requested, 1, run_unit, SILENT):
        one, other = (each.outputs["causal"] for each in (outcome, found[place]))
        assert found[place].sequence_hash == outcome.sequence_hash
        np.testing.assert_array_equal(one.nees_pose, other.nees_pose)
        np.testing.assert_array_equal(one.position_m, other.position_m)


def test_a_worker_of_another_version_is_reported(local, monkeypatch):
    ours = clusters.numeric_versions() | {"gtsam": "4.9"}
    monkeypatch.setattr(clusters, "numeric_versions", lambda: ours)
    with pytest.raises(ClusterError, match=r"has gtsam 4\.3.*, not 4\.9; install"):
        Cluster(local.scheduler_address)
    monkeypatch.undo()
    monkeypatch.setattr(clusters, "code_digest", lambda: "other")
    with pytest.raises(ClusterError, match="another version of the toolkit"):
        Cluster(local.scheduler_address)


# Workers need not find this file: a function within a function goes to them as it is.


def test_an_error_of_the_work_is_raised_here(local, units):
    def divided_by_zero(unit: int, _progress: object) -> int:
        return unit // 0

    with Cluster(local.scheduler_address) as cluster, pytest.raises(ZeroDivisionError):
        list(cluster.results([1], divided_by_zero, SILENT))


def test_a_unit_that_ends_its_worker_is_lost_alone(local):
    def kills_at_one(unit: int, _progress: object) -> int:
        if unit == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return unit

    with Cluster(local.scheduler_address) as cluster:
        found = dict(cluster.results([0, 1], kills_at_one, SILENT))
    assert found == {0: 0, 1: LostUnit("the workers that tried it ended before they answered (2 of them)")}


def test_a_scheduler_that_is_not_there_is_reported(monkeypatch):
    monkeypatch.setattr(clusters, "_CONNECT_S", 0.3)
    with pytest.raises(ClusterError, match=r"no scheduler can be reached at tcp://127\.0\.0\.1:9 "):
        Cluster("tcp://127.0.0.1:9")


@pytest.mark.parametrize("address", ["head-node", "tcp://head-node", "tcp://:8786 "])
def test_what_is_no_address_is_reported_before_anything_connects(address):
    with pytest.raises(ClusterError, match="is no address of a scheduler; give one like tcp://host:8786"):
        Cluster(address)

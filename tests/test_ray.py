"""Work on a Ray cluster of two nodes on this machine gives what one process gives, also when a node is killed."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest

from ballbot_gym.env import make_task
from ballbot_train.commands.certify import certify
from ballbot_train.evaluation.runner import Group, MeasuredRun
from ballbot_train.learning.datasets import load_demos
from ballbot_train.learning.demonstrations import DemoConfig, write_demos
from ballbot_train.work import jobs, shards
from ballbot_train.work.executors import Workers, completed

ray = pytest.importorskip("ray")
pytestmark = pytest.mark.slow

SMALL = {"num_cpus": 1, "object_store_memory": 100 * 2**20}


@pytest.fixture(scope="module")
def head():
    from ray import cloudpickle
    from ray.cluster_utils import Cluster

    cloudpickle.register_pickle_by_value(sys.modules[__name__])  # the nodes do not have this file
    os.environ["RAY_worker_niceness"] = "0"  # noqa: SIM112  # else workers wait for everything else on this machine
    cluster = Cluster(initialize_head=True, head_node_args={**SMALL, "include_dashboard": False})
    yield cluster
    cluster.shutdown()


@pytest.fixture
def cluster(head):
    node = head.add_node(**SMALL)
    yield head, node
    if node in head.worker_nodes:
        head.remove_node(node)


def certified_shards(out, workers):
    certify(("stabilize",), 24, shards=str(out / "set"), out=out / "unfinished", workers=workers)
    (arrays,) = shards.Shards(out / "set" / "stabilize")
    return arrays


def results(out, workers):
    groups = [Group(task, "lqr", "rk4") for task in ("stabilize", "turn")]
    done = MeasuredRun(out, workers).measure(groups, 12, record=True)
    times = {"plan_seconds", "step_seconds"}
    return {
        f"{row.task}-{row.episode}": np.array([str(value) for name, value in vars(row).items() if name not in times])
        for row in done
    }


def demonstrations(out, workers):
    config = DemoConfig("stabilize", "lqr", episodes=16, physics="rk4")
    return vars(load_demos(write_demos(config, out / "demos-v0", workers), make_task("stabilize")))


@pytest.mark.parametrize("made", [certified_shards, results, demonstrations])
def test_every_job_arrives_once_and_unchanged_when_a_node_is_killed(made, cluster, tmp_path, monkeypatch):
    head, node = cluster
    expected = made(tmp_path / "serial", 1)
    written = []

    def completed_and_kill(*arguments):
        for key, result in completed(*arguments):
            written.append(key if isinstance(key, range) else key[0])
            if node in head.worker_nodes:
                head.remove_node(node, allow_graceful=False)
            yield key, result

    for module in (jobs, shards):
        monkeypatch.setattr(module, "completed", completed_and_kill)
    found = made(tmp_path / "cluster", Workers(ray=head.address))
    assert 0 < len(written) == len(set(written))
    assert found.keys() == expected.keys()
    for name, array in expected.items():
        assert np.array_equal(found[name], array, equal_nan=array.dtype.kind == "f"), name


def dies_at_three(log, items):
    for item in items:
        with Path(log).open("a") as file:
            file.write(f"{item}\n")
        if item == 3 and Path(log).read_text().split().count("3") == 1:
            os._exit(1)
        yield {"item": item}


def test_a_job_whose_worker_dies_is_tried_again(cluster, tmp_path):
    head, _ = cluster
    work = [jobs.Job("job", dies_at_three, (str(tmp_path / "log"),), tuple(range(6)))]
    counted = []
    address = Workers(ray=head.address)
    (entries,) = jobs.run(work, tmp_path, address, lambda group, count: counted.append(count))
    assert [entry["item"] for entry in entries] == list(range(6))
    assert sum(counted) == 6
    assert (tmp_path / "log").read_text().split() == [*"0123012345"]


def refuses(items):
    yield {"item": 0}
    raise ValueError("no such item")


def test_an_error_of_an_item_is_the_error_of_the_run(cluster, tmp_path):
    head, _ = cluster
    with pytest.raises(ValueError, match=r"^no such item$"):
        jobs.run([jobs.Job("job", refuses, (), (0, 1))], tmp_path, Workers(ray=head.address), lambda *_: None)

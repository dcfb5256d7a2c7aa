# SPDX-License-Identifier: Apache-2.0
"""Campaigns on several machines: a Ray cluster of two nodes on this one."""

from __future__ import annotations

import os

import pytest

from openarm_common.errors import Code
from openarm_evaluation.campaign.campaign import run_campaign
from openarm_evaluation.campaign.cluster import pack, unpack
from openarm_evaluation.campaign.options import CampaignOptions
from tests.refusals import refuses

ray = pytest.importorskip("ray", reason="needs Ray: install the extra `cluster`")
pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def cluster():
    """Two nodes with one processor each, as two machines would be."""
    from ray.cluster_utils import Cluster

    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    small = {"num_cpus": 1, "object_store_memory": 80 * 1024 * 1024, "include_dashboard": False}
    found = Cluster(initialize_head=True, head_node_args=small)
    found.add_node(num_cpus=1, object_store_memory=80 * 1024 * 1024)
    yield found
    ray.shutdown()
    found.shutdown()


def test_both_machines_work_and_a_finished_campaign_asks_for_nothing(cluster, tmp_path) -> None:
    options = CampaignOptions(seeds=(10000, 10002), workers=2, ray=cluster.address)
    done = run_campaign(options, tmp_path)
    assert all(row["placed"] for row in done.rows), [row["message"] for row in done.rows]
    assert len({row["node"] for row in done.rows}) == 2
    assert run_campaign(options, tmp_path).resumed == 2


def test_more_workers_than_processors_and_no_cluster_are_refused(cluster, tmp_path) -> None:
    with refuses(Code.ENVIRONMENT, "has 2 processors, 3 workers were asked for"):
        run_campaign(CampaignOptions(seeds=(1,), workers=3, ray=cluster.address), tmp_path)


def test_without_a_cluster_the_refusal_says_how_to_start_one(tmp_path) -> None:
    with refuses(Code.ENVIRONMENT, "ray start --head"):
        run_campaign(CampaignOptions(seeds=(1,), ray="127.0.0.1:1"), tmp_path)


@pytest.mark.requirement("N-24")
def test_what_a_worker_keeps_of_a_failure_comes_back_whole(tmp_path) -> None:
    (tmp_path / "there" / "deep").mkdir(parents=True)
    (tmp_path / "there" / "deep" / "end.png").write_bytes(b"\x89PNG")
    unpack(pack(tmp_path / "there"), tmp_path / "here")
    assert (tmp_path / "here" / "deep" / "end.png").read_bytes() == b"\x89PNG"
    assert pack(tmp_path / "nothing") == {}

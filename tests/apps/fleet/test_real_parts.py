"""A Dask cluster, an S3 interface and DuckDB, all real."""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import duckdb
import pytest

from asbuilt import FleetOptions, add_logs, fleet_identify, fleet_overview
from fleet_logs import MODEL, content_of, write_logs

HERE = FleetOptions(workers=0)


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return write_logs(tmp_path_factory.mktemp("logs") / "R1", 4)


@pytest.fixture(scope="module")
def filled(logs: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    ledger = tmp_path_factory.mktemp("fleet") / "ledger"
    assert not add_logs(ledger, MODEL, logs, robot_id="R1", fleet=HERE).failed
    return ledger


@pytest.mark.study
def test_a_cluster_writes_the_same_ledger_though_a_worker_is_killed(
    filled: Path, logs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Paths are relative to a folder that is not that of the workers."""
    distributed = pytest.importorskip("distributed")
    ledger = tmp_path / "ledger"
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        dashboard_address=None,
        silence_logs=logging.CRITICAL,
    ) as cluster:
        victim = cluster.workers[0].pid

        def kill() -> None:
            while not list(ledger.rglob("*.parquet")):
                time.sleep(0.005)
            os.kill(victim, signal.SIGKILL)

        killer = threading.Thread(target=kill)
        killer.start()
        fleet = FleetOptions(scheduler=cluster.scheduler_address)
        monkeypatch.chdir(tmp_path)
        relative = [os.path.relpath(log) for log in logs]
        done = add_logs("ledger", MODEL, relative, robot_id="R1", fleet=fleet)
        killer.join()
    assert not done.failed
    assert len(done.added) + len(done.skipped) == len(logs)
    assert content_of(ledger) == content_of(filled)


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    server_of = pytest.importorskip("moto.server").ThreadedMotoServer
    s3fs = pytest.importorskip("s3fs")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "testing")
    server = server_of(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
    s3fs.S3FileSystem.clear_instance_cache()
    s3fs.S3FileSystem().mkdir("lab")
    yield "s3://lab/fleet/ledger"
    s3fs.S3FileSystem.clear_instance_cache()
    server.stop()


@pytest.mark.study
def test_a_ledger_in_an_object_store_is_the_same(
    filled: Path, logs: list[Path], bucket: str
) -> None:
    s3fs = pytest.importorskip("s3fs")
    done = add_logs(bucket, MODEL, logs, robot_id="R1", fleet=HERE)
    assert len(done.added) == len(logs)
    files = s3fs.S3FileSystem()
    stored = {
        path.removeprefix("lab/fleet/ledger/"): files.cat_file(path)
        for path in files.find("lab/fleet/ledger")
    }
    assert stored == content_of(filled)
    again = add_logs(bucket, MODEL, logs, robot_id="R1", fleet=HERE)
    assert len(again.skipped) == len(logs)
    there, here = (fleet_identify(place, "R1").result for place in (bucket, filled))
    assert there.estimates.tolist() == here.estimates.tolist()
    assert fleet_overview(bucket).robots == fleet_overview(filled).robots


def test_duckdb_reads_the_ledger(filled: Path, logs: list[Path]) -> None:
    rows = duckdb.sql(
        "SELECT robot_id, joint, count(DISTINCT source_sha256), sum(n_samples)"
        f" FROM '{filled}/logs/*/*.parquet' WHERE block = -1 GROUP BY ALL ORDER BY joint"
    ).fetchall()
    n_samples = fleet_identify(filled, "R1").result.n_samples
    assert rows == [("R1", joint, len(logs), n_samples) for joint in MODEL.joint_names]

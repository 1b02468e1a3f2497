"""Candidates of a diagnosis run on a Dask cluster by nothing more than joblib's configuration."""

import joblib
import pytest

from concent_warp.diagnosis.cfg import DiagnoseCfg
from concent_warp.diagnosis.diagnose import diagnose
from tests.diagnosis.same_results import assert_same
from tests.scenes.swinging import drawing, swung

distributed = pytest.importorskip("distributed")


def test_a_local_cluster_finds_what_one_process_finds():
    recording = swung(seconds=1.0)
    cfg = DiagnoseCfg(effects=("joint_damping", "armature", "joint_friction"), jobs=1, explain=False)
    alone = diagnose(drawing(recording), recording, cfg)
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
        joblib.parallel_config(backend="dask"),
    ):
        shared = diagnose(drawing(recording), recording, DiagnoseCfg(effects=cfg.effects, jobs=-1, explain=False))
        ran = client.run(lambda dask_worker: dask_worker.state.executed_count)
    assert_same(shared.to_json(), alone.to_json())
    assert all(count > 0 for count in ran.values())

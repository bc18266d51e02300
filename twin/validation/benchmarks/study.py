"""How much sooner a study is done on two workers than on one."""

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from ..studies.cluster import dask, on_cluster
from ..studies.experiments import experiment
from ..studies.runs import Run, runs_of
from ..studies.study import run_study
from ..studies.study_file import StudyFile
from .rows import Row, limited

STUDY = StudyFile.model_validate(
    {
        "name": "benchmark",
        "kind": "cost",
        "settings": [
            "camera.rows=360", "camera.cols=480", "twin.optics.camera_focal_px=8506.125", "twin.render.nodes_edges=16",
            "procedure.postures=7", "procedure.planes=10", "procedure.plane_step_mm=0.3",
        ],
        "seeds": 4,
    }
)  # fmt: skip

LIMIT = 0.6
"""Of the time that one worker takes."""


def rows(rig_name: str, overrides: Sequence[str]) -> list[Row]:
    """Time the same study on a local Dask cluster of one worker of one thread, and of two.

    The workers have been started and have loaded what they need. Raises InputError where Dask is not installed.
    """
    runs = runs_of(STUDY.model_copy(update={"rig": rig_name}), overrides)
    one, two = (_seconds(runs, workers) for workers in (1, 2))
    name = f"study of {len(runs)} instruments, two workers of one thread"
    return [limited(name, two, "s", "the same, one worker", two / one, LIMIT)]


def _seconds(runs: Sequence[Run], workers: int) -> float:
    distributed = dask()
    with (
        tempfile.TemporaryDirectory() as folder,
        distributed.LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster,
    ):
        with distributed.Client(cluster, set_as_default=False) as client:
            client.run(experiment, STUDY.kind)
        execute_all = on_cluster(cluster.scheduler_address)
        start = time.perf_counter()
        run_study(STUDY, runs, Path(folder), execute_all)
        return time.perf_counter() - start

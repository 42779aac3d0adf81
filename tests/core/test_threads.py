"""How many threads linear algebra has where the estimators solve."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from colmap_inertial.core.threads import usable_processors

#: Prints how many threads BLAS has in each solve of what stands in place of ``WORK``, by function.
COUNTED = """
import json, sys
import numpy as np
from tests.helpers.refine_walk import tracks_of, walk
from threadpoolctl import threadpool_info
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.inertial.refine._panels import Layout, PanelFactor
from colmap_inertial.io.calibration import calibration_prior
from colmap_inertial.model import Model, trajectory_from_model
from colmap_inertial.run.stages.metric import MetricStage, gravity_in_model, metric_trajectory, smooth_path
from colmap_inertial.run.stages.refine import RefineStage

PLACES = ("scipy/linalg/_decomp_cholesky.py", "scipy/linalg/_basic.py", "core/arrow.py", "refine/_panels.py")
SOLVES = ("cholesky_banded", "cho_solve_banded", "cho_factor", "cho_solve", "solve_triangular", "solve", "marginals")
SOLVES += ("_factor", "_subtract", "_substitute")
threads = {}

def counted(frame, event, what):
    place, name = frame.f_code.co_filename, frame.f_code.co_name
    if event == "return" and name in SOLVES and any(part in place for part in PLACES):
        most = max(one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas")
        threads[name] = max(most, threads.get(name, 0))

WORK
sys.setprofile(None)
print(json.dumps(threads))
"""

RUN = """
tracks = tracks_of(walk(7.0))
stages = {"imu": tracks.imu, "calibration": calibration_prior()}
model = Model(reconstruction=tracks.reconstruction(), colmap_index=0, timing=tracks.timing)
metric, refine = MetricStage(**stages), RefineStage(**stages, refine_intrinsics=False)
sys.setprofile(counted)
model = metric(model)
path, _ = trajectory_from_model(model.reconstruction, model.timing)
smooth_path(metric_trajectory(path), tracks.imu, model.scale, gravity_in_model(model))
refine(model)
"""

#: What loads SciPy's library is the solve itself.
ALONE = """
assert "scipy.linalg" not in sys.modules
sys.setprofile(counted)
with one_blas_thread():
    layout = Layout.make(np.arange(2), 9, np.array([1]), np.array([0]))
    values = np.zeros(layout.size_bytes // 8)
    values[layout.entries[2]] = 1.0
    PanelFactor.of(layout, values).marginals()
"""


@pytest.mark.skipif(usable_processors() < 2, reason="BLAS has one thread anyway")
@pytest.mark.parametrize(
    ("work", "solves"),
    [
        (RUN, "_factor _substitute _subtract cho_factor cho_solve cho_solve_banded cholesky_banded marginals solve"),
        (ALONE, "_factor _substitute _subtract marginals"),
    ],
    ids=["run", "alone"],
)
def test_every_solve_of_a_fresh_process_has_one_thread(work, solves):
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    command = [sys.executable, "-c", COUNTED.replace("WORK", work), str(Path(__file__).parents[2])]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == dict.fromkeys(solves.split(), 1)


def test_blas_stays_limited_until_the_last_thread_leaves():
    """In a process of its own: here, an outer context holds throughout."""
    code = """
import threading
import scipy.linalg
from threadpoolctl import ThreadpoolController
from colmap_inertial.core.threads import one_blas_thread

def counts():
    blas = ThreadpoolController().select(user_api="blas")
    return {library["num_threads"] for library in blas.info()}

before, seen = counts(), []
first_is_in, first_is_out = threading.Event(), threading.Event()

def first():
    with one_blas_thread():
        first_is_in.set()
        second_is_in.wait()
    first_is_out.set()

second_is_in = threading.Event()
thread = threading.Thread(target=first)
thread.start()
first_is_in.wait()
with one_blas_thread():
    second_is_in.set()
    first_is_out.wait()
    seen.append(counts())
    with one_blas_thread():
        seen.append(counts())
    seen.append(counts())
thread.join()
print(before, seen, counts())
"""
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    environment["OPENBLAS_NUM_THREADS"] = "2"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True)
    assert done.stdout.strip() == "{2} [{1}, {1}, {1}] {2}"

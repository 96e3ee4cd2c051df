"""The prediction-error fit is compiled in a second process, once."""

import os
import subprocess
import sys

import pytest

from tests.helpers.places import ROOT

SCRIPT = """
from pipeline.gap import explain as beside
from pipeline.plant.simulator.compiler import is_compiled

print(is_compiled(beside._FOLDER, function="predict_run"))
with beside.predictor_compiled():
    pass
print(is_compiled(beside._FOLDER, function="predict_run"))
"""


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.skipif(os.cpu_count() == 1, reason="needs two cores")
def test_the_second_process_stores_the_compiled_code(tmp_path):
    """After the block, an empty folder contains the compiled code."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["False", "True"]

"""The variables of `make test-other-cpu` change the processor that the libraries see."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from tests import other_cpu

SEEN = """
import json
import numba, torch
from tests import other_cpu
print(json.dumps([other_cpu.wide_features(), other_cpu.blas_kernel(), numba.config.CPU_NAME]))
"""


def seen(settings):
    result = subprocess.run(
        # A name that NumPy does not know, or cannot do without, would be a warning.
        [sys.executable, "-W", "error", "-c", SEEN],
        env={**os.environ, **settings},
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(result.stdout)


def test_no_wide_feature_is_left_and_the_kernel_is_another():
    settings = other_cpu.settings()
    features, kernel, name = seen(settings)
    assert features == []
    assert kernel is None or kernel != other_cpu.blas_kernel()
    assert name == "generic"


def test_a_shell_can_take_the_variables_apart():
    for name, value in other_cpu.settings().items():
        assert name.isupper()
        assert value == value.strip()
        assert " " not in value

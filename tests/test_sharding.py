"""Fits that several devices or processes share give the numbers of one."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]


def _start(port: int, processes: int, number: int, devices: int = 1) -> subprocess.Popen:
    flags = f"--xla_force_host_platform_device_count={devices}"
    return subprocess.Popen(
        [sys.executable, "tests/distributed_fit.py", str(port), str(processes), str(number)],
        cwd=ROOT,
        env={**os.environ, "XLA_FLAGS": flags, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def _result(process: subprocess.Popen) -> tuple[int, np.ndarray, np.ndarray]:
    out, err = process.communicate(timeout=600)
    assert process.returncode == 0, err[-3000:]
    line = next(line for line in out.splitlines() if line.startswith("RESULT"))
    size, theta, std = json.loads(line.removeprefix("RESULT"))
    return size, np.array(theta), np.array(std)


@pytest.fixture(scope="module")
def alone():
    return _result(_start(0, 1, 0))


def _close(found, alone):
    np.testing.assert_allclose(found[1], alone[1], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found[2], alone[2], rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_two_processes_on_loopback_return_the_estimate_of_one(alone):
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    pair = [_start(port, 2, k) for k in range(2)]
    for found in [_result(process) for process in pair]:
        assert found[0] == 2
        _close(found, alone)


@pytest.mark.slow
def test_devices_of_one_host_share_recordings_that_do_not_divide_evenly(alone):
    """Three recordings on two devices."""
    found = _result(_start(0, 1, 0, devices=2))
    assert found[0] == 2
    _close(found, alone)

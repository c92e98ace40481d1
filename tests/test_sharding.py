"""Fits that several devices or processes share give the numbers of one."""

import dataclasses
import json
import os
import socket
import subprocess
import sys
import threading
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid.control import Tracking
from jaxid.estimate.minimise import (
    Problem,
    linearisation,
    linearise,
    linearising,
    point_around,
    reweighted,
)
from jaxid.parameters import Bounds
from jaxid.simulation.batch import prepare
from jaxid.simulation.steps import with_substeps

ROOT = Path(__file__).parents[1]
DEMO = ROOT / "jaxid" / "demo" / "clean"
FILES = [DEMO / f"{name}.csv" for name in ("fit_1", "fit_2", "held_out")]


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


def test_devices_of_one_host_share_recordings_that_do_not_divide_evenly(alone):
    """Three recordings on two devices."""
    found = _result(_start(0, 1, 0, devices=2))
    assert found[0] == 2
    _close(found, alone)


@pytest.mark.parametrize("law", [None, Tracking()], ids=["own controller", "virtual controller"])
def test_cores_that_share_recordings_give_the_linearisation_of_one(law, monkeypatch):
    """Three recordings on two cores: one comes twice, and counts once."""
    loop, recordings = jaxid.scara(law), jaxid.read(*FILES)
    problem, theta, start = _problem(loop, recordings)
    one = point_around(problem, theta, start)
    seen = []

    def spy(part, theta, start):
        seen.append(start.shape[0])
        return point_around(part, theta, start)

    monkeypatch.setattr(linearising, "cores", lambda: 2)
    monkeypatch.setattr(linearising, "_WORTH_SHARING", 0)
    monkeypatch.setattr(linearising, "point_around", spy)
    shared = linearisation(problem)(theta, start)
    assert seen == [2, 2]
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(shared), strict=True):
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.max(np.abs(a), initial=0.0))


def test_an_estimated_smoothing_needs_no_other_program_along_an_imposed_motion(monkeypatch):
    loop, recordings = jaxid.scara(Tracking()), jaxid.read(*FILES)
    programs = []

    def spy(part, theta, start):
        kinds = [(np.shape(x), np.asarray(x).dtype) for x in jax.tree.leaves((part, theta, start))]
        programs.append((jax.tree.structure(part), kinds))
        return point_around(part, theta, start)

    monkeypatch.setattr(linearising, "point_around", spy)
    sizes = []
    for one in (loop, loop.free("eps1", "form2")):
        problem, theta, start = _problem(one, recordings)
        found = linearisation(problem, whole=True)(theta, start)
        sizes.append(found.found.jacobian.shape[-1])
        expected = point_around(problem, theta, start)
        np.testing.assert_allclose(found.sums.gram, expected.sums.gram, rtol=1e-9)
        np.testing.assert_allclose(found.found.jacobian, expected.found.jacobian, rtol=1e-9)
    assert sizes[1] == sizes[0] + 2
    assert programs[0] == programs[1]


def test_a_mesh_of_one_host_device_takes_its_shares_on_one_thread(monkeypatch):
    problem, theta, start = _problem(jaxid.scara(), jaxid.read(*FILES))
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:1]), ("recordings",))
    threads = []

    def spy(part, theta, start):
        threads.append(threading.get_ident())
        return point_around(part, theta, start)

    monkeypatch.setattr(linearising, "_AT_A_TIME", 1)
    monkeypatch.setattr(linearising, "point_around", spy)
    linearise(dataclasses.replace(problem, mesh=mesh), theta, start)
    assert len(threads) == 3
    assert len(set(threads)) == 1


def test_new_weights_need_no_simulation():
    problem, theta, start = _problem(jaxid.scara(), jaxid.read(*FILES))
    ratio = jnp.array([2.0, 0.3])
    other = dataclasses.replace(problem, weights=problem.weights * ratio)
    expected = point_around(other, theta, start)
    found = reweighted(other, point_around(problem, theta, start), ratio)
    for a, b in zip(jax.tree.leaves(expected), jax.tree.leaves(found), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.max(np.abs(a), initial=0.0))


def test_importing_uses_no_device_and_waits_for_no_statistics():
    """Other processes can still be joined after it, and a command starts sooner."""
    code = (
        "import sys, jaxid; from jax._src import xla_bridge; assert not xla_bridge._backends; "
        "assert not {'scipy.stats', 'scipy.signal', 'scipy.optimize'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


def _problem(loop, recordings):
    """What OEM minimises, with every initial state free, and where it starts."""
    loop = with_substeps(loop, recordings)
    batch = prepare(loop, recordings)
    bounds = Bounds.of(loop.free_parameters)
    noise = jnp.zeros((2, 16)).at[:, 0].set(1.0).at[:, 1].set(-0.5)
    fields = loop, batch, jnp.array([3.0, 7.0]), noise, jnp.ones(3), bounds.lower, bounds.upper
    start = jnp.concatenate([batch.q0, batch.v0], axis=1)
    return Problem(*fields, ("tau",), True), loop.theta, start

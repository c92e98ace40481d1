"""What jaxid changes in the process that imports it: each time looked at in a fresh one."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.extend.backend
import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid import compiling
from jaxid.compiling import compiled
from jaxid.storage.classes import hints
from jaxid.storage.saved import registry

ROOT = Path(__file__).parents[1]
THRESHOLD = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=16777216"
BESIDE = "import jax, equinox, diffrax, optimistix"


def fresh(code: str, **environment: str) -> str:
    """What a new process prints that has none of this one's XLA flags."""
    dropped = ("XLA_FLAGS", "JAXID_SET_XLA_FLAGS", "JAX_COMPILATION_CACHE_DIR")
    clean = {name: value for name, value in os.environ.items() if name not in dropped}
    paths = os.pathsep.join(filter(None, (str(ROOT), clean.get("PYTHONPATH"))))
    ran = subprocess.run(
        [sys.executable, "-c", code],
        env=clean | {"PYTHONPATH": paths} | environment,
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, ran.stderr[-3000:]
    return ran.stdout.strip()


FLAGS_AFTER = "import jaxid, os; print(os.environ.get('XLA_FLAGS'))"
OTHER = "--xla_cpu_multi_thread_eigen=false"
THEIRS = "--xla_backend_extra_options=xla_cpu_small_call_byte_threshold=7"


@pytest.mark.parametrize(
    ("environment", "left"),
    [
        ({}, THRESHOLD),
        ({"JAXID_SET_XLA_FLAGS": "0"}, "None"),
        ({"XLA_FLAGS": OTHER}, f"{OTHER} {THRESHOLD}"),
        ({"XLA_FLAGS": THEIRS}, THEIRS),
    ],
)
def test_import_sets_the_threshold_where_nobody_else_has_a_say(environment, left):
    assert fresh(FLAGS_AFTER, **environment) == left


def test_environment_stays_as_it_is_once_a_backend_runs():
    assert fresh(f"import jax; jax.devices(); {FLAGS_AFTER}") == "None"


def test_import_starts_no_backend():
    code = "import jaxid; from jax._src.xla_bridge import backends_are_initialized as runs; "
    assert fresh(f"{code} print(runs())") == "False"


@pytest.mark.parametrize(
    ("given", "asked", "left"),
    [
        ("", None, THRESHOLD),
        ("", "1", THRESHOLD),
        (OTHER, "0", OTHER),
        (f"{OTHER} {THEIRS}", None, f"{OTHER} {THEIRS}"),
        ("file_of_flags", None, "file_of_flags"),
    ],
)
def test_threshold_joins_what_xla_flags_hold(monkeypatch, given, asked, left):
    """`XLA_FLAGS` may name a file instead, to which nothing can be added."""
    monkeypatch.setattr(compiling, "_backend_runs", lambda: False)
    monkeypatch.setenv("XLA_FLAGS", given)
    monkeypatch.delenv("JAXID_SET_XLA_FLAGS", raising=False)
    if asked is not None:
        monkeypatch.setenv("JAXID_SET_XLA_FLAGS", asked)
    compiling.set_loop_threshold()
    assert os.environ["XLA_FLAGS"] == left


LARGE = (
    "import json, sys; {}; "
    "print(json.dumps([m for m in sys.modules if m.split('.')[0] in "
    "('pandas', 'plotly', 'rich', 'typer', 'scipy', 'pyarrow', 'narwhals')]))"
)


def test_import_loads_no_large_package_that_its_peers_do_not():
    beside = set(json.loads(fresh(LARGE.format(BESIDE))))
    assert set(json.loads(fresh(LARGE.format("import jaxid")))) <= beside


def test_names_of_rooms_that_come_later_are_there():
    """`import jaxid` leaves rooms out, but none of their names: not where asked, nor in `dir`."""
    for room, names in jaxid._LATER.items():
        module = getattr(jaxid, room)
        assert {room, *names} <= set(dir(jaxid))
        assert all(getattr(jaxid, name) is getattr(module, name) for name in names)
    with pytest.raises(AttributeError, match="no attribute 'undiscovered'"):
        jaxid.undiscovered  # noqa: B018


def test_saved_results_of_rooms_that_come_later_are_read_in_a_fresh_process(tmp_path):
    """The classes of a file must be found before anything else has imported them."""
    path = tmp_path / "limits.jaxid"
    limits = jaxid.Limits(low=[-1.0], high=[1.0], speed=[1.0], acceleration=[9.0], torque=[5.0])
    jaxid.save(limits, path)
    assert fresh(f"import jaxid; print(type(jaxid.load({str(path)!r})).__name__)") == "Limits"


def test_annotations_of_all_classes_can_be_read():
    """A saved file is checked against them; pandas is named in some, and imported for none."""
    for cls in registry().values():
        if cls.__module__.startswith("jaxid.") and dataclasses.is_dataclass(cls):
            assert {field.name for field in dataclasses.fields(cls)} <= set(hints(cls)), cls


# One program of jaxid's, at the top and inside others, and one of the user's.
PROGRAMS = """
import jaxid, jax, jax.numpy as jnp
from jaxid.compiling import compiled
from jaxid.storage.classes import hints
from jaxid.storage.saved import registry

@compiled
def ours(x): return jnp.sin(x)

@jax.jit
def theirs(x): return jnp.cos(x)

@jax.jit
def around(x): return ours(x) + 1

x = jnp.arange(3.0)
for program in (ours, theirs, around): program(x)
"""


def options_of_programs(folder: Path, flags: str = "", **environment: str) -> dict[str, str]:
    """XLA's options of each program that the process compiled, by the program's name."""
    flags = f"--xla_dump_to={folder} --xla_dump_hlo_as_text {flags}".strip()
    fresh(PROGRAMS, XLA_FLAGS=flags, **environment)
    files = folder.glob("*.debug_options")
    return {file.name.split(".")[1].removeprefix("jit_"): file.read_text() for file in files}


def has_options(options: str) -> bool:
    # What is false or zero is not printed.
    said = {line.strip() for line in options.splitlines()}
    emitters = "xla_cpu_use_fusion_emitters: true"
    level, parts = "xla_backend_optimization_level: 1", "xla_cpu_parallel_codegen_split_count: 1"
    return {level, parts} <= said and emitters not in said


def has_threshold(options: str) -> bool:
    lines = [line.strip() for line in options.splitlines()]
    named = 'key: "xla_cpu_small_while_loop_byte_threshold"'
    return named in lines and lines[lines.index(named) + 1] == 'value: "16777216"'


def test_options_are_of_jaxids_programs_alone(tmp_path):
    found = options_of_programs(tmp_path)
    assert {name: has_options(found[name]) for name in ("ours", "theirs", "around")} == {
        "ours": True,
        "theirs": False,
        "around": False,
    }
    assert all(map(has_threshold, found.values()))


def test_without_the_flag_programs_have_their_options_all_the_same(tmp_path):
    found = options_of_programs(tmp_path, JAXID_SET_XLA_FLAGS="0")
    assert has_options(found["ours"])
    assert not any(map(has_threshold, found.values()))


def test_level_that_the_user_asks_for_holds(tmp_path):
    found = options_of_programs(tmp_path, "--xla_backend_optimization_level=2")
    assert all("xla_backend_optimization_level: 2" in found[name] for name in ("ours", "theirs"))


@pytest.mark.parametrize("backends", [{"cpu", "cuda"}, {"tpu", "cpu"}])
def test_accelerators_get_no_options(monkeypatch, backends):
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    asked = compiling._options.__wrapped__
    monkeypatch.setattr(jax.extend.backend, "backends", lambda: {"cpu": None})
    assert asked() == compiling._OPTIONS
    monkeypatch.setattr(jax.extend.backend, "backends", lambda: dict.fromkeys(backends))
    assert asked() == {}


def test_options_that_this_version_of_xla_lacks_are_left_out(monkeypatch):
    monkeypatch.setitem(compiling._OPTIONS, "xla_of_another_time", 1)
    assert set(compiling._options.__wrapped__()) == set(compiling._OPTIONS) - {
        "xla_of_another_time"
    }


def test_only_the_programs_that_were_used_last_are_kept():
    """A long session with many robots must not keep the programs of all of them."""
    traced = []

    @compiled
    def total(x, name):
        traced.append((x.shape, name))
        return jnp.sum(x), name

    for size in range(1, compiling._KEPT + 1):
        value, name = total(np.ones(size), "a")
        assert (float(value), name) == (size, "a")
    assert float(total(np.ones(1), "a")[0]) == 1.0
    assert len(traced) == compiling._KEPT
    # Another static argument is another program, for which that of size 2 is given up.
    assert total(np.ones(1), "b")[1] == "b"
    total(np.ones(1), "a")
    assert len(traced) == compiling._KEPT + 1
    total(np.ones(2), "a")
    assert traced[-1] == ((2,), "a")
    assert len(traced) == compiling._KEPT + 2


def test_compiled_functions_work_inside_other_programs():
    """JAX refuses options of a program that is called inside another one."""
    cube = compiled(lambda x: x**3)
    x = jnp.linspace(-1.0, 2.0, 4)
    ways = {
        "alone": (cube(x), x**3),
        "jit": (jax.jit(cube)(x), x**3),
        "vmap": (jax.vmap(cube)(x), x**3),
        "grad": (jax.vmap(jax.grad(cube))(x), 3 * x**2),
        "jacfwd": (jnp.diag(jax.jacfwd(cube)(x)), 3 * x**2),
        "jvp": (jax.jvp(cube, (x,), (x,))[1], 3 * x**3),
        "scan": (jax.lax.scan(lambda c, y: (c, cube(y)), 0.0, x)[1], x**3),
        "compiled": (compiled(cube)(x), x**3),
    }
    for way, (found, expected) in ways.items():
        # Eight roundings at the most: cubes and products of numbers up to 12.
        np.testing.assert_allclose(found, expected, rtol=0, atol=8 * 12 * 2.0**-53, err_msg=way)

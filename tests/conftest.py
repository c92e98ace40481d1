"""Set up JAX and shape checking before anything imports jaxid; fixtures for shared recordings."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import jaxtyping
import pytest


def _configure_jax() -> None:
    """Keep each worker to one thread, and compiled programs between workers and runs."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    # A handful of states never fills a thread pool, and the workers already use every core.
    flag = "--xla_cpu_multi_thread_eigen=false"
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_cpu_multi_thread_eigen" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {flag}".strip()
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxid-tests"
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")


_configure_jax()
# A whole number where a float is asked for is no mistake (PEP 484's numeric tower).
jaxtyping.install_import_hook(
    "jaxid", "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))"
)

# After the hook, for it imports jaxid: fixtures that tests of several files share.
from stories import bump_case, bump_story, offset_case, offset_story, small_fit  # noqa: E402, F401

SHARED_DATA = Path(__file__).parents[1].parent / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the recordings kept beside the checkout; skips where it is absent."""
    if not SHARED_DATA.is_dir():
        pytest.skip("no ../shared/data beside the checkout")
    return SHARED_DATA


@pytest.fixture(scope="session")
def chromium() -> str:
    """Path of the system's chromium, which also draws figures as images; skips where absent."""
    names = ("chromium", "chromium-browser", "google-chrome", "chrome")
    found = next((path for path in map(shutil.which, names) if path), None)
    if found is None:
        pytest.skip(f"none of {', '.join(names)} is installed")
    return found


@pytest.fixture(scope="session")
def shared_file() -> Callable[[str], Path]:
    """Give a function from a path below ../shared/data to the file; it skips where absent."""

    def find(name: str) -> Path:
        path = SHARED_DATA / name
        if not path.exists():
            pytest.skip(f"no ../shared/data/{name} beside the checkout")
        return path

    return find

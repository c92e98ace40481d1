"""Wheel and sdist hold what they should, and the wheel runs without the checkout."""

import email
import os
import subprocess
import sys
import tarfile
import zipfile
from email.message import Message
from importlib import metadata
from pathlib import Path

import pytest
from fresh_install import ROOT, build
from packaging.requirements import Requirement
from typer.testing import CliRunner

import jaxid
from jaxid.cli import app


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A wheel and an sdist of the checkout, by their endings."""
    pytest.importorskip("hatchling", reason="the extra `dev` is not installed")
    if not (ROOT / "pyproject.toml").is_file():
        pytest.skip("the package's source tree is not here")
    found = build(ROOT, tmp_path_factory.mktemp("dist"))
    return {path.suffix: path for path in found}


def names_in(wheel: Path) -> set[str]:
    """The files of a wheel."""
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


def metadata_of(wheel: Path) -> Message:
    """The wheel's own account of itself."""
    with zipfile.ZipFile(wheel) as archive:
        name = next(n for n in archive.namelist() if n.endswith(".dist-info/METADATA"))
        return email.message_from_bytes(archive.read(name))


def test_the_wheel_has_the_package_and_its_recordings_and_nothing_else(
    built: dict[str, Path],
) -> None:
    names = names_in(built[".whl"])
    source = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "jaxid").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert names - source == {n for n in names if ".dist-info/" in n}
    assert source <= names
    for story in ("clean", "hidden"):
        for name in ("fit_1", "fit_2", "held_out"):
            assert f"jaxid/demo/{story}/{name}.csv" in names
    assert {"jaxid/py.typed", "jaxid/report/page.css", "jaxid/report/page.js"} <= names
    assert any(n.endswith(".dist-info/licenses/LICENSE") for n in names)
    assert built[".whl"].stat().st_size < 1_000_000


def test_metadata_say_version_python_and_extras(built: dict[str, Path]) -> None:
    said = metadata_of(built[".whl"])
    assert said["Name"] == "jaxid-robotics"
    assert said["Version"] == jaxid.__version__
    assert said["Requires-Python"] == ">=3.11"
    assert said["License-Expression"] == "Apache-2.0"
    needed = [Requirement(text) for text in said.get_all("Requires-Dist", [])]
    core = {r.name for r in needed if r.marker is None}
    assert {"jax", "equinox", "diffrax", "optimistix", "plotly", "typer"} <= core
    assert not core & {"mujoco", "pytest", "pin", "mkdocs-material"}
    install = (ROOT / "docs" / "install.md").read_text(encoding="utf-8")
    for extra in said.get_all("Provides-Extra", []):
        assert f"`{extra}`" in install, f"docs/install.md does not name the extra {extra}"


def test_the_sdist_builds_the_same_wheel(built: dict[str, Path], tmp_path: Path) -> None:
    with tarfile.open(built[".gz"]) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
        archive.extractall(tmp_path, filter="data")
    assert {"README.md", "CHANGELOG.md", "CITATION.cff", "LICENSE", "docs/index.md"} <= names
    assert any(name.startswith("tests/test_") for name in names)
    source = tmp_path / built[".gz"].name.removesuffix(".tar.gz")
    again = build(source, tmp_path / "dist", "wheel")[0]
    assert names_in(again) == names_in(built[".whl"])


def test_the_unpacked_wheel_runs_without_the_checkout(
    built: dict[str, Path], tmp_path: Path
) -> None:
    with zipfile.ZipFile(built[".whl"]) as archive:
        archive.extractall(tmp_path / "unpacked")
    program = "import jaxid; print(jaxid.__file__); from jaxid.cli import main; main()"
    there = {**os.environ, "PYTHONPATH": str(tmp_path / "unpacked")}
    command = [sys.executable, "-c", program, "--version"]
    ran = subprocess.run(
        command, cwd=tmp_path, env=there, capture_output=True, text=True, check=True
    )
    file, version = ran.stdout.splitlines()
    assert Path(file).is_relative_to(tmp_path)
    assert version == f"jaxid {jaxid.__version__}"


def test_the_version_is_written_in_one_place() -> None:
    assert CliRunner().invoke(app, ["--version"]).stdout == f"jaxid {jaxid.__version__}\n"
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert "\nversion =" not in text.split("[build-system]")[-1].split("[project.optional")[0]
    assert f"\nversion: {jaxid.__version__}\n" in (ROOT / "CITATION.cff").read_text("utf-8")
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    newest = next(line for line in changes.splitlines() if line.startswith("## "))
    assert newest.split()[1] == jaxid.__version__
    assert metadata.version("jaxid-robotics") == jaxid.__version__

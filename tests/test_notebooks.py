"""Every notebook runs as it is, and holds the figures of its last run."""

import os
from pathlib import Path

import pytest

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
NAMES = sorted(path.name for path in NOTEBOOKS.glob("*.ipynb"))
DATA = Path(__file__).parents[2] / "shared" / "data"
EMPS, KR300 = DATA / "emps", DATA / "kr300"

FEWER = {"seed in range(40)": "seed in range(6)", "draws=200": "draws=20"}

nbformat = pytest.importorskip("nbformat", reason="the extra `notebook` is not installed")


def test_there_are_seven() -> None:
    assert [name[:2] for name in NAMES] == [f"{k}_" for k in range(1, 8)]


@pytest.mark.parametrize("name", NAMES)
def test_it_holds_its_figures_and_no_error(name: str) -> None:
    path = NOTEBOOKS / name
    assert path.stat().st_size < 1.5 * 2**20
    notebook = nbformat.read(path, 4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(cell.execution_count for cell in code)
    outputs = [output for cell in code for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error"]
    # Pictures, which a forge shows, and not only figures that need a script.
    assert sum("image/png" in output.get("data", {}) for output in outputs) >= 1
    said = "".join(output.get("text", "") for output in outputs)
    assert "/home" not in said
    assert "/tmp" not in said


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_it_runs(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    nbclient = pytest.importorskip("nbclient", reason="the extra `notebook` is not installed")
    pytest.importorskip("ipykernel", reason="the extra `notebook` is not installed")
    if EMPS.is_dir():
        monkeypatch.setenv("EMPS", str(EMPS))
    if "measured_arm" in name and not KR300.is_dir():
        pytest.skip("no ../shared/data/kr300 beside the checkout")
    monkeypatch.setenv("KR300", str(KR300))
    # Figures as data: no browser draws them.
    monkeypatch.setenv("PLOTLY_RENDERER", "plotly_mimetype")
    root = str(NOTEBOOKS.parent)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([root, os.environ.get("PYTHONPATH", "")]))
    notebook = nbformat.read(NOTEBOOKS / name, 4)
    for cell in notebook.cells:
        # Every cell runs; how true its numbers are is measured elsewhere.
        for many, few in FEWER.items():
            cell.source = cell.source.replace(many, few)
    resources = {"metadata": {"path": str(NOTEBOOKS)}}
    nbclient.NotebookClient(notebook, timeout=600, resources=resources).execute()
    shown = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert any("application/vnd.plotly.v1+json" in o.get("data", {}) for o in shown)

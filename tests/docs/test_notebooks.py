# SPDX-License-Identifier: MIT
"""The notebooks of docs run, and come out as they say; they are kept without outputs."""

import os
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs" / "notebooks"
EXPECTED = {  # held in the notebook's own Python after its last cell
    "old_factor": """
assert 3 * means["warped factor"] < means["old factor"] < means["block Jacobi"]
assert apart < 1e-5 and paths.min() < -0.3
assert change["nodes"] < 0.5 * change["room"]
assert 10 * conditions["warped factor"] < conditions["old factor"]
assert 10 * conditions["warped factor"] < conditions["block Jacobi"]
""",
    "identify_a_material": """
assert abs(found["values"][YOUNG] / truth[YOUNG] - 1) < 0.01
assert abs(found["values"][MASS] / truth[MASS] - 1) < 0.1
assert 0.5 * misfit_of_noise < found["misfit"] < 2 * misfit_of_noise
""",
}


def test_all_are_run() -> None:
    assert {path.stem for path in FOLDER.glob("*.ipynb")} == set(EXPECTED)


@pytest.mark.parametrize("name", EXPECTED)
def test_they_are_kept_without_outputs(name: str) -> None:
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    nbformat.validate(notebook)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert cells and not any(cell.outputs or cell.execution_count for cell in cells)


@pytest.mark.system
@pytest.mark.timeout(1000)  # it makes servers by the dozen, one after another
@pytest.mark.parametrize("name", EXPECTED)
def test_notebooks_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a kernel of its own, with the code of this tree."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    notebook.cells.append(nbformat.v4.new_code_cell(EXPECTED[name]))
    NotebookClient(
        notebook, timeout=900, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert any("image/png" in output.get("data", {}) for output in outputs)

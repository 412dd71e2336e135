"""The notebooks of the tutorials run from top to bottom, in an empty folder and with fewer steps."""

import json
import os
import re
import sys
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = sorted((ROOT / "examples" / "tutorials").glob("*.ipynb"))
MAX_LINES = 15
"""Maximum number of lines of a code cell."""
KERNEL = "tutorial"
RUNS = [
    ("1_environment_and_expert", "", r"'is_success': True.*\nequal after set_state\(\): True"),
    ("2_train", "STEPS = 4", r"success rate [01]\.\d\d in 4 episodes\n(.*\n)*.*success_rate="),
    ("3_task", "EPISODES = 5", r"passes Gymnasium's check_env\n(.*\n)+5 of 5 attempts"),
    ("4_robot", "", r"(\w+: picked the block in \d+ steps\n){5}"),
    ("5_object_and_sensor", "", r"11\.4 cm long\n(.*\n)+step 0: (.*\n)+lifted an object in \d+ steps"),
    ("6_offline_imitation", "EPISODES = UPDATES = 4", r"success rate [01]\.\d\d in 4 episodes"),
    (
        "7_tune_and_benchmark",
        "STEPS = 4\nTRIALS = 4\nSEEDS = [1]",
        r"reaching: 4 complete\n(.*\n)+.*found: (.*\n)+ +found\.png",
    ),
]
"""Name of each notebook, its shortened constants, and a pattern of its output."""


@pytest.fixture
def kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the name of a Jupyter kernel with this interpreter, independent of the user's settings."""
    folder = tmp_path / "jupyter" / "kernels" / KERNEL
    folder.mkdir(parents=True)
    command = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
    spec = {"argv": command, "display_name": KERNEL, "language": "python"}
    (folder / "kernel.json").write_text(json.dumps(spec), encoding="utf-8")
    for variable in ("JUPYTER_PATH", "JUPYTER_DATA_DIR", "JUPYTER_CONFIG_DIR", "IPYTHONDIR"):
        monkeypatch.setenv(variable, str(tmp_path / "jupyter"))
    monkeypatch.setenv("JUPYTER_RUNTIME_DIR", str(tmp_path / "runtime"))
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent), prepend=os.pathsep)  # bulletarm-zoo
    monkeypatch.setenv("PYTHONPATH", str(ROOT), prepend=os.pathsep)
    return KERNEL


@pytest.mark.parametrize(
    ("name", "constants", "pattern"),
    [pytest.param(*run, id=run[0], marks=[pytest.mark.slow] if run is not RUNS[0] else []) for run in RUNS],
)
def test_notebook_runs(name: str, constants: str, pattern: str, kernel: str, tmp_path: Path) -> None:
    """With the constants in place of the cell with the tag "parameters"."""
    notebook = nbformat.read(ROOT / "examples" / "tutorials" / f"{name}.ipynb", as_version=4)
    for cell in notebook.cells:
        if "parameters" in cell.metadata.get("tags", []):
            cell.source = constants
    (folder := tmp_path / "work").mkdir()
    resources = {"metadata": {"path": str(folder)}}
    NotebookClient(notebook, kernel_name=kernel, resources=resources, timeout=1200).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    text = "".join(output.text for output in outputs if output.output_type == "stream")
    assert re.search(pattern, text.replace("\r\n", "\n")), text
    assert any("image/png" in output.get("data", {}) for output in outputs)


def test_every_notebook_is_executed_and_described() -> None:
    names = [path.stem for path in NOTEBOOKS]
    assert names == [name for name, *_ in RUNS]
    page = (ROOT / "docs" / "tutorials.md").read_text(encoding="utf-8")
    assert re.findall(r"\]\(\.\./examples/tutorials/(\w+)\.ipynb\)", page) == names


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_stored_without_outputs(path: Path) -> None:
    content = json.loads(path.read_text(encoding="utf-8"))
    assert path.read_text(encoding="utf-8") == json.dumps(content, indent=1, ensure_ascii=False) + "\n"
    nbformat.validate(content)
    assert content["metadata"]["kernelspec"]["name"] == "python3"
    cells = content["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)
    assert all(len(cell["source"]) <= MAX_LINES for cell in code)

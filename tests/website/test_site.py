"""The site is built strictly: every link, anchor and reference in it leads somewhere."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("mkdocs_api_autonav", reason="the extra docs")

ROOT = Path(__file__).parents[2]
ROLE = re.compile(":(?:attr|class|data|exc|func|meth|mod):[`<]")


@pytest.mark.slow
def test_site_is_built_strictly(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    page = (tmp_path / "tasks" / "OpenLoopBlockStacking" / "index.html").read_text(encoding="utf-8")
    assert 'href="../../api/bulletarm_gym/tasks/stacking/#bulletarm_gym.tasks.stacking.BlockStacking"' in page
    home = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "fonts.googleapis.com" not in home and "fonts.gstatic.com" not in home
    pages = (tmp_path / "api").rglob("*.html")
    left = [path for path in pages if ROLE.search(path.read_text(encoding="utf-8"))]
    assert not left, "roles that Markdown does not know"

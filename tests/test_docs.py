"""Every Python snippet of the documentation runs, in order, page by page."""

import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
SNIPPET = re.compile(r"```python\n(.*?)```", re.DOTALL)
FILE = re.compile(r"# (\w+\.py)\n")
SHORTER = {
    "learn(2_000": "learn(2",
    "expert_episodes=100": "expert_episodes=2",
    "pretrain_steps=500": "pretrain_steps=2",
    "save(": "save(FOLDER + ",
    '"picking.h5"': 'FOLDER + "picking.h5"',
}


def _snippets(page: Path) -> list[str]:
    return SNIPPET.findall(page.read_text(encoding="utf-8"))


@pytest.mark.usefixtures("own_registrations")
@pytest.mark.parametrize(
    "page", [p for p in PAGES if _snippets(p)], ids=lambda page: str(page.relative_to(ROOT))
)
def test_snippets_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    known = set(sys.modules)
    namespace = {"FOLDER": f"{tmp_path}/"}
    for snippet in _snippets(page):
        for long, short in SHORTER.items():
            snippet = snippet.replace(long, short)
        if match := FILE.match(snippet):
            (tmp_path / match[1]).write_text(snippet, encoding="utf-8")
        else:
            exec(compile(snippet, str(page), "exec"), namespace)
    for name in set(sys.modules) - known:
        if name.startswith("my_"):
            del sys.modules[name]

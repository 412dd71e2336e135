"""The snippets of the documentation run, page by page; its commands are accepted; what it names exists."""

import importlib
import inspect
import math
import pkgutil
import re
import shlex
import sys
from pathlib import Path

import pytest

import bulletarm_gym
from fill_tables import filled
from zoo_configs import parsers
from zoo_configs.cli import COMMANDS
from zoo_configs.experiments.config import resolve
from zoo_configs.experiments.flags import find_experiment
from zoo_configs.training.validation import check_experiment

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
SNIPPET = re.compile(r"```python\n(.*?)```", re.DOTALL)
COMMAND = re.compile(r"^ {4,}bulletarm-zoo (.+)$", re.MULTILINE)
NAME = re.compile(r"`((?:bulletarm_gym|sb3_extensions|zoo_configs)(?:\.\w+)+)`")
WITH_COMMANDS = [page for page in PAGES if COMMAND.search(page.read_text(encoding="utf-8"))]
SIGNATURE = re.compile(r"^\| `([\w.]+)\(([^`]*)\)` \|", re.MULTILINE)
NUMBER = re.compile(r"\| `([\w.]+)` \| `([^`]+)` \| (?:paper|release)")
ADDITION = re.compile(r"^\| `(\w+)[^|]*\| ([^|]+) \|", re.MULTILINE)
FILE = re.compile(r"# (\w+\.py)\n")
# The paper's appendix "List of Configurable Environment Parameters".
PAPER_PARAMETERS = (
    "robot action_sequence workspace object_scale_range max_steps num_objects obs_size in_hand_size "
    "fast_mode render random_orientation half_rotation workspace_check close_loop_tray"
).split()
SHORTER = {
    "learn(2_000": "learn(2",
    "expert_episodes=200": "expert_episodes=2",
    "pretrain_steps=800": "pretrain_steps=2",
    "critic_warmup_steps=100": "critic_warmup_steps=1",
    "n_eval_episodes=50": "n_eval_episodes=1",
    "expert_episodes=100": "expert_episodes=2",
    "pretrain_steps=500": "pretrain_steps=2",
    "save(": "save(FOLDER + ",
    '"picking.h5"': 'FOLDER + "picking.h5"',
}


def _snippets(page):
    return SNIPPET.findall(page.read_text(encoding="utf-8"))


def _find(path):
    """Import a module, or what is in one."""
    module, _, name = path.rpartition(".")
    try:
        return importlib.import_module(path)
    except ModuleNotFoundError:
        return getattr(_find(module), name)


@pytest.mark.parametrize("page", WITH_COMMANDS, ids=lambda page: page.name)
def test_commands_are_accepted(page):
    for line in COMMAND.findall(re.sub(r"\\\n\s*", " ", page.read_text(encoding="utf-8"))):
        name, *words = shlex.split(line, comments=True)
        if name in COMMANDS and "..." not in words:
            args = getattr(parsers, f"parse_{name}")(words)
            if name == "train" and args.baseline and args.env in bulletarm_gym.ENV_IDS:
                check_experiment(find_experiment(args))


def test_names_exist():
    for page in PAGES:
        for name in NAME.findall(page.read_text(encoding="utf-8")):
            _find(name)


def test_signatures_of_the_task_guide_are_the_codes():
    """Arguments in their order, and which of them have defaults."""
    found = SIGNATURE.findall((ROOT / "docs" / "guides" / "task.md").read_text(encoding="utf-8"))
    assert len(found) > 10
    for name, arguments in found:
        told = re.findall(r"(\w+)(=[^,]*(?:,\))?)?(?:, |$)", arguments)
        parameters = inspect.signature(_find(f"bulletarm_gym.{name}")).parameters
        assert [argument for argument, _ in told] == list(parameters), name
        for argument, default in told:
            is_optional = parameters[argument].default is not inspect.Parameter.empty
            assert bool(default) == is_optional, f"{name}: {argument}"


def test_provenance_tells_the_numbers_of_the_code():
    found = NUMBER.findall((ROOT / "docs" / "provenance.md").read_text(encoding="utf-8"))
    assert len(found) > 60
    for name, value in found:
        assert _find(name) == pytest.approx(eval(value, {"pi": math.pi})), name


@pytest.mark.parametrize(
    "page, baseline, task",
    [
        ("sacfd", "equi_sacfd", "CloseLoopBlockPulling"),
        ("spatial_dqn", "sdqfd_equi_asr", "OpenLoopHouseBuilding1"),
    ],
)
def test_additions_have_the_values_of_the_preset(page, baseline, task):
    hyperparams = resolve(baseline, "cpu", f"BulletArm/{task}-v0").hyperparams
    text = (ROOT / "docs" / "learners" / f"{page}.md").read_text(encoding="utf-8")
    table = text.partition("Additions to the paper\n")[2].partition("\n#")[0]
    rows = [row for row in ADDITION.findall(table) if not row[0].endswith("kwargs")]
    assert len(rows) > 3
    for name, cell in rows:
        value = hyperparams.get(name, "off")
        shown = "".join(f'`"{key}"`' for key in value) if isinstance(value, dict) else value
        assert cell == (shown if isinstance(shown, str) else f"{shown:,g}"), name


def test_figures_are_those_of_the_data():
    """``make tables`` fills the pages."""
    for page in [*PAGES, ROOT / "CONTRIBUTING.md"]:
        assert filled(page) == page.read_text(encoding="utf-8"), page


def test_the_migration_guide_has_every_environment_and_parameter_of_the_paper():
    page = (ROOT / "docs" / "guides" / "migration.md").read_text(encoding="utf-8")
    ids = re.findall(r"^\| `[a-z_0-9]+` \| `((?:Open|Close)Loop\w+)`", page, re.MULTILINE)
    assert sorted(f"BulletArm/{name}-v0" for name in ids) == sorted(bulletarm_gym.PAPER_IDS)
    told = set(re.findall(r"^\| `([a-z_]+)` \|", page.partition("## Parameters")[2], re.MULTILINE))
    assert told >= {*PAPER_PARAMETERS}


@pytest.mark.usefixtures("own_registrations")
@pytest.mark.parametrize(
    "page", [p for p in PAGES if _snippets(p)], ids=lambda page: str(page.relative_to(ROOT))
)
def test_snippets_run(page, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
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


@pytest.mark.parametrize("package", ["control", "surfaces", "tasks"])
def test_methods_of_components_have_or_inherit_a_docstring(package):
    found = importlib.import_module(f"bulletarm_gym.{package}")
    for module in pkgutil.iter_modules(found.__path__, f"{found.__name__}."):
        for _, kind in inspect.getmembers(importlib.import_module(module.name), inspect.isclass):
            methods = [] if kind.__module__ != module.name else inspect.getmembers(kind)
            named = [(name, each) for name, each in methods if inspect.isroutine(each) and name[0] != "_"]
            assert not [name for name, each in named if not inspect.getdoc(each)], kind

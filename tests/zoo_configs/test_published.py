"""Agents that come with the package: small, and as good as their cards say."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from scipy import stats

from zoo_configs.agents import AgentQuery, find_agent
from zoo_configs.cli import main
from zoo_configs.evaluating import EvalOptions, Outcome, evaluate_agent
from zoo_configs.experiments.rules import task_name
from zoo_configs.publishing.packing import arithmetic
from zoo_configs.publishing.published import Published, published_agents
from zoo_configs.publishing.readme import render_readme

Refuse = Callable[..., str]
AGENTS = {f"{task_name(agent.card.env)}-{agent.card.label}": agent for agent in published_agents()}
GOALS = {"BlockStacking": 0.85, "HouseBuilding": 0.85, "ObjectGrasping": 0.85}
OPEN_LOOP_GOALS = {
    "HouseBuilding4": 0.8,
    "ImproviseHouseBuilding3": 0.8,
    "CovidTest": 0.8,
    "ObjectGrasping": 0.8,
}
CLOSE_LOOP_GOAL, OPEN_LOOP_GOAL = 0.95, 0.9
ONE, ALL = 1_000_000, 10_000_000  # bytes
FEW = 4  # episodes
UNLIKELY = 1e-4

every_agent = pytest.mark.parametrize("agent", AGENTS.values(), ids=AGENTS)


def evaluate(agent: Published, episodes: int) -> Outcome:
    """As ``enjoy --published`` does, on the scenes of the card."""
    query = AgentQuery(published=agent.card.env, baseline=agent.card.label, device="cpu")
    return evaluate_agent(find_agent(query), EvalOptions(episodes, agent.card.test_seed, progress=False))


def repeats(agent: Published) -> bool:
    """Whether the card was measured where the same bits come out."""
    return {key: agent.card.measured[key] for key in arithmetic()} == arithmetic()


def test_agents_are_small() -> None:
    files = {name: agent.model_file.stat().st_size for name, agent in AGENTS.items()}
    assert files
    assert max(files.values()) < ONE, files
    assert sum(path.stat().st_size for agent in AGENTS.values() for path in agent.folder.iterdir()) < ALL


@every_agent
def test_a_card_tells_of_an_agent_that_reached_its_goal(agent: Published) -> None:
    card = agent.card
    assert agent.model_file.is_file()
    assert agent.folder.parts[-2:] == (task_name(card.env), card.label)
    assert card.episodes == 100
    assert card.success == card.outcomes.count("1") / card.episodes
    assert card.interval[0] <= card.success <= card.interval[1]
    for name in ("command", "commit", "date", "machine", "versions"):
        assert getattr(card, name), name
    task = task_name(card.env)
    close_loop = task.startswith("CloseLoop")
    goals, other = (GOALS, CLOSE_LOOP_GOAL) if close_loop else (OPEN_LOOP_GOALS, OPEN_LOOP_GOAL)
    assert card.success >= goals.get(task.removeprefix("CloseLoop").removeprefix("OpenLoop"), other)


@every_agent
def test_a_page_is_made_of_the_card(agent: Published) -> None:
    assert (agent.folder / "README.md").read_text(encoding="utf-8") == render_readme(agent.card)


@pytest.mark.parametrize("name", ["CloseLoopBlockReaching-equi_sacfd", "CloseLoopBlockPicking-equi_sacfd"])
def test_first_episodes_end_as_the_card_says(name: str) -> None:
    """Where it was measured each of them; elsewhere they are not too few for the success of the card."""
    agent = AGENTS[name]
    successes = evaluate(agent, FEW).successes
    if repeats(agent):
        assert successes == [outcome == "1" for outcome in agent.card.outcomes[:FEW]]
    assert stats.binom.cdf(sum(successes), FEW, agent.card.interval[0]) > UNLIKELY


@pytest.mark.slow
@every_agent
def test_success_is_that_of_the_card(agent: Published) -> None:
    """Where it was measured episode by episode; elsewhere within the width of the card's interval."""
    outcome, card = evaluate(agent, agent.card.episodes), agent.card
    if repeats(agent):
        assert "".join("01"[success] for success in outcome.successes) == card.outcomes
    assert abs(outcome.success_rate - card.success) <= card.interval[1] - card.interval[0]


def test_the_list_tells_success(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "--published"]) == 0
    printed = capsys.readouterr().out
    for agent in AGENTS.values():
        assert agent.card.env in printed


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["Frobnication"], "'Frobnication', choose from CloseLoopBlockInBowl"),
        (["CloseLoopBlockPickin"], "did you mean 'CloseLoopBlockPicking'?"),
        (["blockreaching"], "did you mean 'CloseLoopBlockReaching'?"),
        (["CloseLoopBlockReaching", "--baseline", "frobnicate"], "'frobnicate', choose from equi_sacfd"),
        (["CloseLoopBlockReaching", "--env", "TOY"], "neither a path nor --env"),
    ],
)
def test_what_is_not_published(words: list[str], message: str, refuse: Refuse) -> None:
    assert message in refuse("enjoy", "--published", *words)

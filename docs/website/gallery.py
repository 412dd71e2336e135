"""The gallery: an image of every environment with a link to its page."""

from website.catalogue import Shown, grouped

HEAD = """---
title: Gallery
hide: [toc]
---

# Tasks

Select a task to open its page. Each image shows the start of an episode and the scene solved by the expert.

All tasks have [sparse rewards](../environments.md): 1 on success, else 0.

"""


def page() -> str:
    """Return the Markdown of the gallery."""
    return HEAD + "\n".join(_group(heading, members) for heading, members in grouped().items())


def _group(heading: str, members: list[Shown]) -> str:
    return (
        f'## {heading}\n\n<div class="gallery" markdown>\n\n' + "\n".join(map(_card, members)) + "\n</div>\n"
    )


def _card(one: Shown) -> str:
    image = f"![{one.name}](../images/tasks/{one.image}.webp){{ loading=lazy }}"
    return f"[{image} **{one.title}** <span>{one.setting}</span>]({one.name}.md){{ .card }}\n"

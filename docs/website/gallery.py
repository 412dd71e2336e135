"""The gallery: a picture of every environment, which leads to its page."""

from website.catalogue import Shown, grouped

HEAD = """---
title: Gallery
hide: [toc]
---

# Tasks

Every environment as an episode begins, and solved by its expert. A picture leads to the page of its task.

"""


def page() -> str:
    """Return the Markdown of the gallery."""
    return HEAD + "\n".join(_group(heading, members) for heading, members in grouped().items())


def _group(heading: str, members: list[Shown]) -> str:
    return (
        f'## {heading}\n\n<div class="gallery" markdown>\n\n' + "\n".join(map(_card, members)) + "\n</div>\n"
    )


def _card(one: Shown) -> str:
    image = f"![{one.name}](../images/tasks/{one.picture}.webp){{ loading=lazy }}"
    return f"[{image} **{one.title}** <span>{one.setting}</span>]({one.name}.md){{ .card }}\n"

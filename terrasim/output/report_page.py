"""The page that every report is: one HTML file that needs nothing else."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from html import escape
from importlib.resources import files
from string import Template

Fact = tuple[str, str, str]
"""A label, a figure, and what stands below it."""
Section = tuple[str, str, str]
"""A name, a title, and HTML; left out where that is empty."""


def page(
    title: str,
    description: str,
    *,
    facts: Iterable[Fact],
    notices: str = "",
    pictures: Iterable[str] = (),
    sections: Iterable[Section] = (),
    version: str = "",
) -> str:
    """The page as text.

    Args:
        title: What it is about.
        description: A sentence or two below that.
        facts: The figures that come first.
        notices: HTML that must not be missed.
        pictures: Figures, as :func:`figure` makes them.
        sections: What follows.
        version: Of terrasim.
    """
    template = Template((files("terrasim.output") / "report.html").read_text(encoding="utf-8"))
    return template.substitute(
        title=escape(title),
        description=escape(description),
        facts="\n".join(
            f'<div class="fact"><span class="label">{escape(label)}</span><span class="value">'
            f'{escape(value)}</span><span class="sub">{escape(below)}</span></div>'
            for label, value, below in facts
        ),
        synthetic=notices,
        pictures="\n".join(pictures),
        sections="\n".join(
            f'<section id="{name}"><h2>{escape(heading)}</h2>\n{content}\n</section>'
            for name, heading, content in sections
            if content
        ),
        version=escape(version),
    )


def figure(content: bytes, alt: str, caption: str) -> str:
    """A PNG with what it shows; both texts are no HTML yet."""
    data = base64.b64encode(content).decode("ascii")
    return (
        f'<figure><img src="data:image/png;base64,{data}" alt="{escape(alt)}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def notice(strong: str, text: str) -> str:
    """A box that must not be missed; ``text`` is no HTML yet."""
    return f'<p class="notice"><strong>{escape(strong)}</strong> {escape(text)}</p>'

"""Markdown -> markdown: links to files of the repository outside of the site become their names."""

import re

OUTSIDE = re.compile(r"\[([^\]]+)\]\(\.\./([^)]+)\)")


def _named(link: re.Match) -> str:
    text, path = link.groups()
    name = path.rpartition("/")[2]
    return f"`{path}`" if text.strip("`") == name else f"{text} (`{path}`)"


def on_page_markdown(markdown: str, **_) -> str:
    return OUTSIDE.sub(_named, markdown)

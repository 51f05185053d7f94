"""Names and messages that come from files are data: what keeps them so in a terminal and in Markdown.

The templates of the report escape HTML, `files.write_csv` what a spreadsheet takes for a formula.
"""

import unicodedata
from typing import Any

try:
    from rich.console import Console
    from rich.text import Text
except ModuleNotFoundError as error:
    from ballbot_gym.lazy import missing  # which brings NumPy along: `ballbot --help` needs none

    raise missing(__name__, error.name) from error

_MARKDOWN = str.maketrans({sign: f"&#{ord(sign)};" for sign in "&<>|{}`\\*"} | {"\n": " ", "\r": " "})


def printable(text: str) -> str:
    """Text without control characters, which could rewrite the screen or turn the writing around; they are spelt out."""
    return "".join(
        sign if sign in "\n\t" or unicodedata.category(sign) not in ("Cc", "Cf", "Cs") else ascii(sign)[1:-1]
        for sign in text
    )


def markdown_text(text: str) -> str:
    """Text as Markdown shows it in a table or a line: no markup, link, HTML or expression of MDX."""
    return printable(text.translate(_MARKDOWN)).replace("](", "]&#40;")


class PlainConsole(Console):
    """A console that prints text as it is: no markup, no emoji, no control characters."""

    def __init__(self, **options: Any):
        super().__init__(markup=False, emoji=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(printable(text), **options)

"""Pieces of HTML; every text that comes from outside is escaped here."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

#: Marks a cell of a table as a number, which stands to the right.
Cell = str | float | int | None


def text(value: object) -> str:
    """A text between tags or in an attribute."""
    return escape(str(value), quote=True)


def number(value: float | None, digits: int = 2, unit: str = "") -> str:
    """A number with thousands apart; an en dash where there is none."""
    if value is None or value != value:
        return "–"
    return f"{round(value, digits) + 0.0:,.{digits}f}{unit}".replace("-", "−")


def share(part: float | None, digits: int = 2) -> str:
    """A share as per cent."""
    return "–" if part is None or part != part else f"{100.0 * part:.{digits}f} %"


def table(
    head: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    caption: str = "",
    right: Iterable[int] = (),
    asked: Iterable[int] = (),
    mono: Iterable[int] = (),
) -> str:
    """A table; its first column names the rows.

    Parameters
    ----------
    head : sequence of str
    rows : iterable of sequence of str
        Plain text.
    caption : str
    right, mono : iterable of int
        Columns of numbers, of code.
    asked : iterable of int
        Rows that stand out.
    """
    numbers, marked, code = set(right), set(asked), set(mono)

    def cell(column: int, content: str) -> str:
        tag = "th" if column == 0 else "td"
        scope = ' scope="row"' if column == 0 else ""
        kind = ' class="n"' if column in numbers else ' class="mono"' if column in code else ""
        return f"<{tag}{scope}{kind}>{text(content)}</{tag}>"

    heads = "".join(
        f'<th scope="col"{" class=n" if i in numbers else ""}>{text(name)}</th>' for i, name in enumerate(head)
    )
    body = "\n".join(
        f"<tr{' class=asked' if k in marked else ''}>{''.join(cell(i, c) for i, c in enumerate(row))}</tr>"
        for k, row in enumerate(rows)
    )
    told = f"<caption>{text(caption)}</caption>" if caption else ""
    return f'<div class="scroll"><table>{told}<thead><tr>{heads}</tr></thead>\n<tbody>\n{body}\n</tbody></table></div>'


def items(lines: Iterable[str]) -> str:
    """A list."""
    return "<ul>" + "".join(f"<li>{text(line)}</li>" for line in lines) + "</ul>"


def absent(sentence: str) -> str:
    """What the page does not show, and why."""
    return f'<p class="absent">{text(sentence)}</p>'

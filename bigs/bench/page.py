"""Tables of text, and a Markdown page of them."""

from __future__ import annotations

from typing import NamedTuple

Rows = list[tuple[str, ...]]


class Table(NamedTuple):
    """Rows of equal length, the heading first, and a note on how to read them."""

    title: str
    note: str
    rows: Rows


def page(title: str, introduction: str, tables: list[Table]) -> str:
    """A Markdown page."""
    lines = [f"# {title}", "", introduction]
    for table in tables:
        heading, *body = table.rows
        lines += ["", f"## {table.title}", "", table.note, "", _row(heading)]
        lines += [_row(("---",) * len(heading)), *map(_row, body)]
    return "\n".join(lines) + "\n"


def _row(cells: tuple[str, ...]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"

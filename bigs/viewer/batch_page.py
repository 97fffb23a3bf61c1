"""The page of a batch: a row for each clip, with its picture and a link to its report."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

from bigs.atomic import atomic_write

_STYLE = """
:root { color-scheme: light dark; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1200px; margin: 2em auto; padding: 0 1em; }
table { border-collapse: collapse; width: 100%; }
th, td { padding: .3em .7em; border-bottom: 1px solid #8886; text-align: left; vertical-align: top; }
th:nth-last-child(2) { min-width: 12em; }
td { font-variant-numeric: tabular-nums; overflow-wrap: anywhere; }
img { width: 320px; max-width: 25vw; display: block; }
.finished { color: #1a7f37; } .failed { color: #cf222e; } .running { color: #9a6700; }
"""


class PageRow(NamedTuple):
    """One clip; paths are relative to the page."""

    cells: Sequence[str]
    state: str
    report: str | None
    picture: str | None


def write_batch_page(path: Path, *, title: str, heading: Sequence[str], rows: Sequence[PageRow]) -> None:
    """Write the page; `path` is whole or absent.

    Args:
        path: the .html file, in the folder that `rows` start from.
        title: its heading.
        heading: names of the columns.
        rows: one per clip; the first cell becomes the link to the report, the second shows the state.
    """
    head = "".join(f"<th>{escape(name)}</th>" for name in (*heading, ""))
    body = "\n".join(_row(row) for row in rows)
    document = (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{_STYLE}</style></head>\n<body><h1>{escape(title)}</h1>\n"
        f"<table><tr>{head}</tr>\n{body}</table></body></html>\n"
    )
    with atomic_write(path) as file:
        file.write(document.encode())


def _row(row: PageRow) -> str:
    name, state, *rest = map(escape, row.cells)
    link = name if row.report is None else f'<a href="{quote(row.report)}">{name}</a>'
    cells = [f"<td>{link}</td>", f'<td class="{escape(row.state)}">{state}</td>']
    cells += [f"<td>{cell}</td>" for cell in rest]
    picture = (
        ""
        if row.picture is None
        else f'<img loading="lazy" src="{quote(row.picture)}" alt="{escape(row.cells[0])}">'
    )
    return f"<tr>{''.join(cells)}<td>{picture}</td></tr>"

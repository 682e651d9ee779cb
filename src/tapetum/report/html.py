"""Report pages that stand alone: one HTML file, styles and pictures inside, nothing asked of any network.

Small functions that each return a piece of `Html`; `page` puts the pieces together. Text is escaped wherever
it comes in, so that no file name or label can become markup; only what is `Html` already passes as it is. A
content policy in the page forbids scripts and every outside request.
"""

from __future__ import annotations

import base64
import html
import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from tapetum.errors import InputError
from tapetum.files import atomic_file
from tapetum.report.figures import figure_png

__all__ = [
    "Html",
    "bullets",
    "details",
    "facts",
    "figure",
    "headline",
    "join",
    "note",
    "page",
    "paragraph",
    "section",
    "table",
    "text",
    "write_page",
]

STYLE = """
:root{color-scheme:light dark;--ink:#1b1f24;--quiet:#5b6472;--rule:#d9dee5;--paper:#fff;--panel:#f5f7fa;
--link:#005b94;--good:#00694b;--mark:#9a3c00}
@media(prefers-color-scheme:dark){:root{--ink:#e7eaee;--quiet:#a2abb8;--rule:#333b46;--paper:#14171b;
--panel:#1d2127;--link:#7cc4f5;--good:#5cd6a9;--mark:#ffab70}}
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--ink);
font:16px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,"DejaVu Sans",sans-serif}
main{max-width:62rem;margin:0 auto;padding:2.5rem 1.25rem 4rem}
h1{font-size:1.9rem;line-height:1.2;margin:0 0 .35rem}
h2{font-size:1.3rem;margin:2.8rem 0 .6rem;padding-top:.7rem;border-top:1px solid var(--rule)}
h3{font-size:1.05rem;margin:1.6rem 0 .4rem}
p,ul{margin:.6rem 0;max-width:46rem}
ul{padding-left:1.25rem}
.lead{color:var(--quiet);font-size:1.05rem;margin:0 0 1.4rem}
.numbers{display:grid;grid-template-columns:repeat(auto-fit,minmax(15rem,1fr));gap:.8rem;margin:1.4rem 0}
.numbers div{background:var(--panel);border-radius:.5rem;padding:.85rem 1rem}
.numbers b{display:block;font-size:1.65rem;line-height:1.2;font-variant-numeric:tabular-nums}
.numbers span{display:block;color:var(--quiet);font-size:.86rem;line-height:1.35;margin-top:.25rem}
figure{margin:1.3rem 0}
figure img{display:block;max-width:100%;height:auto;margin:0 auto;background:#fff;border-radius:.4rem;
padding:.45rem;border:1px solid var(--rule)}
figcaption,caption{color:var(--quiet);font-size:.88rem;line-height:1.45;text-align:left}
figcaption{margin-top:.5rem;max-width:52rem}
caption{caption-side:bottom;padding-top:.45rem}
.scroll{overflow-x:auto;margin:1rem 0}
table{border-collapse:collapse;font-size:.94rem;font-variant-numeric:tabular-nums;min-width:50%}
th,td{padding:.34rem .9rem .34rem 0;text-align:left;vertical-align:top;border-bottom:1px solid var(--rule)}
thead th{border-bottom:2px solid var(--quiet);font-weight:600;white-space:nowrap}
tbody th{font-weight:500}
.n{text-align:right;white-space:nowrap}
.best td,.best th{font-weight:700}
.note{border-left:.25rem solid var(--mark);background:var(--panel);padding:.6rem 1rem;
border-radius:0 .4rem .4rem 0;max-width:48rem;margin:1rem 0}
details{margin:1rem 0;border:1px solid var(--rule);border-radius:.5rem;padding:.2rem 1rem}
summary{cursor:pointer;padding:.45rem 0;font-weight:600}
code{font-family:ui-monospace,SFMono-Regular,Menlo,Consolas,"DejaVu Sans Mono",monospace;font-size:.9em;
background:var(--panel);border-radius:.25rem;padding:.06em .3em}
nav{font-size:.9rem;margin:1rem 0;display:flex;flex-wrap:wrap;gap:.25rem 1.1rem}
a{color:var(--link)}
footer{margin-top:3rem;padding-top:.8rem;border-top:1px solid var(--rule);color:var(--quiet);font-size:.86rem}
@media print{:root{color-scheme:light;--ink:#000;--quiet:#444;--rule:#bbb;--paper:#fff;--panel:#f3f3f3;
--mark:#9a3c00;--link:#000}
body{font-size:10.5pt}main{max-width:none;padding:0}nav{display:none}figure,table,.numbers,.note{break-inside:avoid}
h2,h3{break-after:avoid}details{border:0;padding:0}@page{margin:16mm}}
"""


class Html(str):
    """Markup that was made here, safe to put in a page as it stands."""

    __slots__ = ()


def text(value: object) -> Html:
    """Return anything as escaped text; `Html` as it is; `code` between backquotes."""
    if isinstance(value, Html):
        return value
    parts = html.escape(str(value), quote=True).split("`")
    if len(parts) % 2 == 0:  # an odd backquote is only a character
        return Html("`".join(parts))
    return Html("".join(f"<code>{part}</code>" if k % 2 else part for k, part in enumerate(parts)))


def join(pieces: Iterable[object]) -> Html:
    """Return pieces one after another, escaped where they are not `Html`."""
    return Html("\n".join(text(piece) for piece in pieces))


def paragraph(*pieces: object, kind: str = "") -> Html:
    """Return a paragraph; `kind` is its CSS class."""
    mark = f' class="{html.escape(kind, quote=True)}"' if kind else ""
    return Html(f"<p{mark}>{' '.join(text(piece) for piece in pieces)}</p>")


def note(*pieces: object) -> Html:
    """Return a paragraph that must not be overlooked."""
    return Html(f'<div class="note" role="note">{" ".join(text(piece) for piece in pieces)}</div>')


def bullets(items: Iterable[object]) -> Html:
    """Return a list with bullets."""
    return Html("<ul>" + "".join(f"<li>{text(item)}</li>" for item in items) + "</ul>")


def headline(numbers: Iterable[tuple[object, object]]) -> Html:
    """Return the numbers a reader came for, large: (value, what it is)."""
    cells = (f"<div><b>{text(value)}</b><span>{text(what)}</span></div>" for value, what in numbers)
    return Html(f'<div class="numbers">{"".join(cells)}</div>')


def table(
    columns: Sequence[object],
    rows: Iterable[Sequence[object]],
    *,
    caption: object = "",
    numeric: Iterable[int] = (),
    best: int | None = None,
) -> Html:
    """Return a table whose first column heads its rows.

    Parameters
    ----------
    columns
        Headings.
    rows
        As many cells each.
    caption
        Below the table.
    numeric
        Columns set flush right.
    best
        Row set in bold.

    Raises
    ------
    InputError
        When a row has another number of cells.
    """
    right = frozenset(numeric)
    mark = ['class="n"' if k in right else "" for k in range(len(columns))]
    head = "".join(f'<th scope="col" {mark[k]}>{text(cell)}</th>' for k, cell in enumerate(columns))
    body: list[str] = []
    for number, row in enumerate(rows):
        if len(row) != len(columns):
            raise InputError(f"row {number} has {len(row)} cells for {len(columns)} columns", where="table")
        cells = "".join(
            f'<th scope="row" {mark[k]}>{text(cell)}</th>' if k == 0 else f"<td {mark[k]}>{text(cell)}</td>"
            for k, cell in enumerate(row)
        )
        body.append(f"<tr{' class=best' if number == best else ''}>{cells}</tr>")
    below = f"<caption>{text(caption)}</caption>" if caption else ""
    inner = f"{below}<thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody>"
    return Html(f'<div class="scroll"><table>{inner}</table></div>')


def facts(pairs: Iterable[tuple[object, object]], *, caption: object = "") -> Html:
    """Return a table of names and values."""
    rows = "".join(f'<tr><th scope="row">{text(a)}</th><td>{text(b)}</td></tr>' for a, b in pairs)
    below = f"<caption>{text(caption)}</caption>" if caption else ""
    return Html(f'<div class="scroll"><table>{below}<tbody>{rows}</tbody></table></div>')


def figure(picture: Figure | bytes, *, alt: str, caption: object = "", dpi: int = 160) -> Html:
    """Return a picture inside the page.

    Parameters
    ----------
    picture
        A Matplotlib figure, or a PNG file's bytes.
    alt
        What the picture shows, for those who do not see it; required.
    caption
        Below it.
    dpi
        Of a Matplotlib figure.

    Raises
    ------
    InputError
        When `alt` is empty or the bytes are no PNG.
    """
    if not alt.strip():
        raise InputError("a picture needs a description", where="alt", remedy="say what it shows")
    width = ""
    if isinstance(picture, bytes):
        data = picture
    else:
        data = figure_png(picture, dpi)
        # Drawn at 160 dpi for sharp screens and paper, shown at the size it was designed for.
        width = f' width="{round(picture.get_figwidth() * 96)}"'
    if not data.startswith(b"\x89PNG\r\n\x1a\n"):
        raise InputError("not a PNG file", where="picture")
    source = base64.b64encode(data).decode("ascii")
    label = html.escape(" ".join(alt.split()), quote=True)
    below = f"<figcaption>{text(caption)}</figcaption>" if caption else ""
    return Html(f'<figure><img{width} alt="{label}" src="data:image/png;base64,{source}">{below}</figure>')


def details(summary: object, *pieces: object) -> Html:
    """Return pieces that a reader opens when wanted."""
    return Html(f"<details><summary>{text(summary)}</summary>{join(pieces)}</details>")


def section(title: str, *pieces: object, level: int = 2) -> Html:
    """Return a titled section; those of level 2 appear in the page's contents."""
    if level not in (2, 3):
        raise InputError(f"must be 2 or 3, is {level}", where="level")
    name = "".join(c if c.isalnum() else "-" for c in title.lower()).strip("-")
    mark = html.escape(name, quote=True)
    return Html(f'<section id="{mark}"><h{level}>{text(title)}</h{level}>{join(pieces)}</section>')


def page(
    title: str,
    *pieces: object,
    subtitle: object = "",
    contents: Sequence[str] = (),
    footer: object = "",
    language: str = "en",
) -> str:
    """Return a whole page.

    Parameters
    ----------
    title
        Of the page and its first heading.
    pieces
        Its body.
    subtitle
        A sentence below the title.
    contents
        Titles of sections to link to.
    footer
        Below everything.
    language
        Of the text, for readers aloud.
    """
    links = "".join(
        f'<a href="#{"".join(c if c.isalnum() else "-" for c in name.lower()).strip("-")}">{text(name)}</a>'
        for name in contents
    )
    top = join(
        [
            Html(f"<h1>{text(title)}</h1>"),
            *([paragraph(subtitle, kind="lead")] if subtitle else []),
            *([Html(f'<nav aria-label="Contents">{links}</nav>')] if links else []),
        ]
    )
    bottom = f"<footer>{text(footer)}</footer>" if footer else ""
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
    return (
        f'<!doctype html>\n<html lang="{html.escape(language, quote=True)}">\n<head>\n'
        '<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<main>\n"
        f"{top}\n{join(pieces)}\n{bottom}\n</main>\n</body>\n</html>\n"
    )


def write_page(path: str | os.PathLike[str], content: str) -> Path:
    """Write a page in UTF-8, whole or not at all."""
    target = Path(path)
    with atomic_file(target) as part:
        part.write_text(content, encoding="utf-8")
    return target

"""Self-contained report pages: one HTML file with its styles and pictures.

Each function returns a piece of `Html`, and `page` assembles them. All text but `Html` is escaped, so no file name or
label becomes markup. The page's content policy forbids scripts and outside requests.
"""

from __future__ import annotations

import base64
import html
import os
import re
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from tapetum.errors import InputError
from tapetum.files import atomic_file
from tapetum.models.prediction import NONE_OF_THESE
from tapetum.report.figures import figure_png
from tapetum.report.formatting import look, written
from tapetum.report.verdicts import MEAN, NARROW, warnings

__all__ = [
    "Html",
    "bullets",
    "details",
    "facts",
    "figure",
    "headings",
    "headline",
    "join",
    "note",
    "page",
    "paragraph",
    "render",
    "section",
    "share",
    "table",
    "text",
    "write_page",
]


class Html(Markup):
    """Escaped markup, safe to put into a page."""

    __slots__ = ()


def text(value: object) -> Html:
    """Return anything as escaped text; `Html` as it is; `code` between backquotes."""
    if isinstance(value, Markup):
        return Html(value)
    parts = html.escape(str(value), quote=True).split("`")
    if len(parts) % 2 == 0:  # an unpaired backquote is an ordinary character
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
    """Return the main numbers in large type, from (value, what it is)."""
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
    columns, rows
        Headings, and rows of as many cells.
    caption
        Below the table.
    numeric, best
        Columns set flush right, and the row set in bold.

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
        written = [text(_glued(cell) if k in right else cell) for k, cell in enumerate(row)]
        cells = "".join(
            f'<th scope="row" {mark[k]}>{cell}</th>' if k == 0 else f"<td {mark[k]}>{cell}</td>"
            for k, cell in enumerate(written)
        )
        body.append(f"<tr{' class=best' if number == best else ''}>{cells}</tr>")
    # A page that is narrower than its table scrolls the table, not what is written below it.
    below = f"<caption><span>{text(caption)}</span></caption>" if caption else ""
    inner = f"{below}<thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody>"
    return Html(f'<div class="scroll"><table>{inner}</table></div>')


def _glued(cell: object) -> object:
    """A cell of numbers whose signs and units stay beside them: a narrow page divides it after a stroke alone."""
    if not isinstance(cell, str) or isinstance(cell, Html):
        return cell
    return cell.replace(" ", "\N{NO-BREAK SPACE}").replace("/\N{NO-BREAK SPACE}", "/ ")


def facts(pairs: Iterable[tuple[object, object]], *, caption: object = "") -> Html:
    """Return a table of names and values."""
    rows = "".join(f'<tr><th scope="row">{text(a)}</th><td>{text(b)}</td></tr>' for a, b in pairs)
    below = f"<caption>{text(caption)}</caption>" if caption else ""
    return Html(f'<div class="scroll"><table>{below}<tbody>{rows}</tbody></table></div>')


def figure(
    picture: Figure | bytes, *, alt: str, caption: object = "", dpi: int = 160, width: int | None = None
) -> Html:
    """Return a picture inside the page.

    Parameters
    ----------
    picture
        A Matplotlib figure, or a PNG file's bytes.
    alt, caption
        Description for readers who cannot see the picture (required), and text below it.
    dpi
        Of a Matplotlib figure.
    width
        On the screen, in pixels of 1/96 inch; a Matplotlib figure's own when None.

    Raises
    ------
    InputError
        When `alt` is empty or the bytes are no PNG.
    """
    if not alt.strip():
        raise InputError("a picture needs a description", where="alt", remedy="say what it shows")
    # Drawn at 160 dpi for sharp screens and paper, shown at the size it was designed for.
    data = picture if isinstance(picture, bytes) else figure_png(picture, dpi)
    if width is None and not isinstance(picture, bytes):
        width = round(picture.get_figwidth() * 96)
    if not data.startswith(b"\x89PNG\r\n\x1a\n"):
        raise InputError("not a PNG file", where="picture")
    source = base64.b64encode(data).decode("ascii")
    words = alt.unescape() if isinstance(alt, Markup) else alt
    label = html.escape(" ".join(words.split()), quote=True)
    below = f"<figcaption>{text(caption)}</figcaption>" if caption else ""
    size = "" if width is None else f' width="{width}"'
    return Html(f'<figure><img{size} alt="{label}" src="data:image/png;base64,{source}">{below}</figure>')


def details(summary: object, *pieces: object) -> Html:
    """Return pieces that a reader opens when wanted."""
    return Html(f"<details><summary>{text(summary)}</summary>{join(pieces)}</details>")


def section(title: str, *pieces: object, level: int = 2) -> Html:
    """Return a titled section; those of level 2 appear in the page's contents."""
    if level not in (2, 3):
        raise InputError(f"must be 2 or 3, is {level}", where="level")
    mark = html.escape(_anchor(title), quote=True)
    return Html(f'<section id="{mark}"><h{level}>{text(title)}</h{level}>{join(pieces)}</section>')


def _anchor(title: str) -> str:
    """Return the name of a section, to link to it."""
    return "".join(c if c.isalnum() else "-" for c in title.lower()).strip("-")


def share(value: float | None, digits: int = 0) -> str:
    """Return a fraction in percent; a dash for None."""
    return "–" if value is None else f"{100 * value:.{digits}f} %"


@cache
def _environment() -> Environment:
    made = Environment(
        loader=PackageLoader("tapetum.report"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        autoescape=True,
        finalize=text,
    )
    pieces = (bullets, details, facts, figure, headline, join, note, section, table)
    made.globals |= {piece.__name__: piece for piece in pieces} | {"look": look, "warnings": warnings}
    made.globals |= {"MEAN": MEAN, "NARROW": NARROW, "NONE_OF_THESE": NONE_OF_THESE}
    made.filters |= {"shown": lambda value, quantity: look(quantity).shown(value)}
    made.filters |= {"anchor": _anchor, "fmt": format, "share": share, "written": written}
    made.filters |= {"seconds": lambda value: f"{value:.1f} s" if value < 120 else f"{value / 60:.1f} min"}
    made.filters |= {"as_code": lambda pairs: [(f"`{name}`", what) for name, what in pairs]}
    return made


def render(template: str, **values: object) -> Html:
    """Render a template of `tapetum/report/templates`; values are escaped where they are not `Html`."""
    return Html(_environment().get_template(template).render(**values))


def headings(body: str) -> list[str]:
    """Return the titles of a body's sections of level 2."""
    return [html.unescape(title) for title in re.findall(r"<h2>(.*?)</h2>", body)]


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
    title, subtitle
        Title of the page and its first heading, and a sentence below it.
    pieces
        Its body.
    contents
        Titles of sections to link to.
    footer
        Below everything.
    language
        Language code of the text, for screen readers.
    """
    values = {"subtitle": subtitle, "contents": contents, "footer": footer, "language": language}
    return str(render("page.html", title=title, body=join(pieces), **values))


def write_page(path: str | os.PathLike[str], content: str) -> Path:
    """Write a page in UTF-8, whole or not at all."""
    target = Path(path)
    with atomic_file(target) as part:
        part.write_text(content, encoding="utf-8")
    return target

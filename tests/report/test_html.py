from __future__ import annotations

import base64
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from tapetum.errors import InputError
from tapetum.report import fig_samples, html
from tapetum.report.formatting import written

VOID = {"meta", "img", "br"}


class Checker(HTMLParser):
    """Keeps every tag and attribute, and complains of tags that do not close."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.feed(page)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


HOSTILE = '<img src=x onerror="alert(1)">&\''


def test_everything_is_escaped() -> None:
    body = [
        html.paragraph(HOSTILE, kind='x" onload="y'),
        html.note(HOSTILE),
        html.bullets([HOSTILE]),
        html.headline([(HOSTILE, HOSTILE)]),
        html.table([HOSTILE], [[HOSTILE]], caption=HOSTILE),
        html.facts([(HOSTILE, HOSTILE)], caption=HOSTILE),
        html.figure(fig_samples(np.ones((1, 3, 3)), np.zeros((1, 2))), alt=HOSTILE, caption=HOSTILE, dpi=20),
        html.details(HOSTILE, HOSTILE),
        html.section(HOSTILE, HOSTILE),
        HOSTILE,
    ]
    page = html.page(HOSTILE, *body, subtitle=HOSTILE, contents=[HOSTILE], footer=HOSTILE, language='"><b>')
    seen = Checker(page)
    images = [attributes for tag, attributes in seen.tags if tag == "img"]
    assert len(images) == 1
    assert images[0]["alt"] == HOSTILE
    assert all(not name.startswith("on") for _, attributes in seen.tags for name in attributes)


def test_html_passes_once_and_code_is_marked() -> None:
    assert html.text(html.paragraph("a < b")) == "<p>a &lt; b</p>"
    assert html.text("run `a<b` now") == "run <code>a&lt;b</code> now"
    assert html.text("one ` only") == "one ` only"


def test_a_page_asks_nothing_of_the_network() -> None:
    page = html.page("T", html.figure(fig_samples(np.ones((1, 3, 3)), np.zeros((1, 2))), alt="one", dpi=20))
    seen = Checker(page)
    assert not any(tag in {"script", "link", "iframe"} for tag, _ in seen.tags)
    sources = [a.get("src") or a.get("href") for _, a in seen.tags if "src" in a or "href" in a]
    assert all(s is not None and s.startswith(("data:", "#")) for s in sources)
    assert "url(" not in page
    assert "@import" not in page
    policy = next(a["content"] for tag, a in seen.tags if tag == "meta" and "http-equiv" in a)
    assert policy is not None
    assert policy.startswith("default-src 'none'")


def test_pictures_come_back_out() -> None:
    figure = fig_samples(np.ones((1, 3, 3)), np.zeros((1, 2)))
    made = Checker(html.figure(figure, alt="one", dpi=20)).tags
    source = next(a["src"] for tag, a in made if tag == "img")
    assert source is not None
    assert base64.b64decode(source.removeprefix("data:image/png;base64,")).startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: html.figure(b"GIF89a", alt="x"), "not a PNG"),
        (lambda: html.figure(b"\x89PNG\r\n\x1a\n", alt=" "), "description"),
        (lambda: html.table(["a", "b"], [["1"]]), "1 cells for 2 columns"),
        (lambda: html.section("t", level=7), "2 or 3"),
    ],
)
def test_bad_pieces_are_refused(make: object, said: str) -> None:
    with pytest.raises(InputError, match=said):
        make()  # type: ignore[operator]


def test_contents_link_to_sections() -> None:
    seen = Checker(html.page("T", html.section("What it’s for", "x"), contents=["What it’s for"]))
    link = next(a["href"] for tag, a in seen.tags if tag == "a")
    name = next(a["id"] for tag, a in seen.tags if tag == "section")
    assert link == f"#{name}"


def test_a_page_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError):
        html.write_page(tmp_path / "file" / "new" / "report.html", "x")
    assert html.write_page(tmp_path / "new" / "r.html", "é").read_text(encoding="utf-8") == "é"


def test_small_errors_keep_two_digits() -> None:
    shown = {0.0: "0.000", 8.14e-5: "0.000081", -0.0023: "-0.0023", 0.0123: "0.012", 3.1: "3.100", 12.34: "12.3"}
    assert {value: written(value) for value in shown} == shown


def test_cells_of_numbers_are_divided_after_a_stroke_alone() -> None:
    page = html.table(["a b", "c d"], [["one row", "0.1 m / 0.2 m"]], numeric=[1], caption="what it is")
    assert "0.1\N{NO-BREAK SPACE}m\N{NO-BREAK SPACE}/ 0.2\N{NO-BREAK SPACE}m<" in page
    assert "c d" in page and "one row" in page and "what it is" in page

"""docs/paper.md holds no result of its own: it includes parts that follow from numbers."""

from __future__ import annotations

import json
import re
from pathlib import Path

import make_paper_page as script

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"


def test_every_part_is_made_of_its_numbers() -> None:
    made = script.made()
    assert set(made) == {"sizes", "learned", "sealed"}
    for name, text in made.items():
        assert (DOCS / "includes" / f"{name}.md").read_text(encoding="utf-8") == text, f"run {script.__file__}"


def test_the_page_includes_all_parts_and_copies_none() -> None:
    page = (DOCS / "paper.md").read_text(encoding="utf-8")
    named = re.findall(r'^--8<-- "(.+)"$', page, re.MULTILINE)
    assert named == ["sizes.md", *(f"{name}.md" for name in script.PAGES), "learned.md", "sealed.md"]
    assert all((DOCS / "includes" / name).is_file() for name in named)
    assert "## Fig" not in page and "## Table" not in page


def test_older_results_name_their_version_and_verdicts_follow_the_numbers() -> None:
    older = json.loads((DOCS / "numbers" / "learned-0.1.0.json").read_text(encoding="utf-8"))
    text = script.made()["learned"]
    sections = re.split(r"^##+ ", text, flags=re.MULTILINE)[1:]
    assert len(sections) == 5
    assert all(f"Tapetum {older['measured']['version']} (commit" in " ".join(one.split()) for one in sections)
    assert "worse than" not in text
    older["focusing"]["models"][0] |= {"x_d": [0.9, 0.078], "f_t": [40.0, 1.0]}
    template = (ROOT / "scripts" / "learned.md.j2").read_text(encoding="utf-8")
    worse = script.render_text(template, older)
    assert "| ResNet-18 | 0.9 / 0.078 | 40 / 1 | 89.4 %, 92.6 % | worse than the training mean |" in worse

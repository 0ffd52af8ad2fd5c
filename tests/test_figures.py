"""The figures of the concept pages: each page has one, which both colour schemes show."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

import crashhunt

PAGES = sorted((Path(crashhunt.__file__).parent / "guide" / "concepts").glob("*.md"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_concept_page_has_a_described_figure_for_light_and_dark_screens(page):
    ((words, target),) = re.findall(r"!\[([^\]]+)\]\(([^)]+\.svg)\)", page.read_text())
    assert len(words.split()) >= 20
    figure = page.parent / target
    assert figure.stat().st_size < 20_000
    drawing = ET.fromstring(figure.read_text())
    title, style = (drawing.find(f"{{http://www.w3.org/2000/svg}}{name}") for name in ("title", "style"))
    assert title.text
    assert "prefers-color-scheme: dark" in style.text
    used = set(re.findall(r"var\((--\w+)\)", figure.read_text()))
    assert all(style.text.count(f"{name}:") == 2 for name in used)

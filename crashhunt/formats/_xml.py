"""XML as the formats want it."""

from __future__ import annotations

import re
from decimal import Decimal
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

from crashhunt.base.files import whole_file
from crashhunt.base.text import one_line

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["add", "comment", "number", "plain_text", "write_xml"]


def add(parent: ET.Element, tag: str, text: str = "", **attributes: str) -> ET.Element:
    """Add an element and return it."""
    element = ET.SubElement(parent, tag, attributes)
    element.text = text or None
    return element


def comment(parent: ET.Element, text: str) -> None:
    """Add a comment, which must not have two dashes in a row."""
    parent.append(ET.Comment(f" {re.sub('-(?=-)', '- ', plain_text(text))} "))


def number(value: float) -> str:
    """Return a number of which every bit is read back, without an exponent: a decimal of XML has none."""
    return format(Decimal(repr(float(value))), "f")


def plain_text(text: str) -> str:
    """Return a text in one line, of characters that XML can hold."""
    return one_line(text).encode("utf-8", "backslashreplace").decode("utf-8")


def write_xml(root: ET.Element, target: Path) -> None:
    """Write a document; the file is never incomplete.

    Raises:
        HuntDirectoryError: it cannot be written.
    """
    ET.indent(root)
    with whole_file(target) as temporary:
        ET.ElementTree(root).write(temporary, encoding="UTF-8", xml_declaration=True)

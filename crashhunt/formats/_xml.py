"""XML in the form that the formats require."""

from __future__ import annotations

import re
from decimal import Decimal
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

from crashhunt.base.files import output_file
from crashhunt.base.text import one_line

if TYPE_CHECKING:
    from pathlib import Path


def add(parent: ET.Element, tag: str, text: str = "", **attributes: str) -> ET.Element:
    """Add an element to its parent and return it."""
    element = ET.SubElement(parent, tag, attributes)
    element.text = text or None
    return element


def comment(parent: ET.Element, text: str) -> None:
    """Add a comment, in which two consecutive dashes are not allowed."""
    parent.append(ET.Comment(f" {re.sub('-(?=-)', '- ', plain_text(text))} "))


def number(value: float) -> str:
    """Return a number as text that preserves every bit, without an exponent, because decimals in XML have none."""
    return format(Decimal(repr(float(value))), "f")


def plain_text(text: str) -> str:
    """Return a text as one line, with only those characters that XML allows."""
    return one_line(text).encode("utf-8", "backslashreplace").decode("utf-8")


def write_xml(root: ET.Element, target: Path) -> None:
    """Write an XML document. The file is never incomplete.

    Raises:
        HuntDirectoryError: the file cannot be written.
    """
    ET.indent(root)
    with output_file(target) as temporary:
        ET.ElementTree(root).write(temporary, encoding="UTF-8", xml_declaration=True)

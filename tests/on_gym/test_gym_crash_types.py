"""Cells of crashes: equal for similar crashes, from the last info alone."""

from __future__ import annotations

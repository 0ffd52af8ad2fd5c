"""The versions of highway-env that the accelerator knows. Nothing is imported here, so a descriptor may ask."""

from __future__ import annotations

ACCELERATED = {"1.12.1": "c2c34aaddeb8f4c7"}
"""The digest of the modules in which the accelerator replaces something, by version of highway-env."""

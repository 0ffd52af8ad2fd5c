"""Gives a distribution the README with absolute links, because PyPI shows it without the files beside it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

_RELATIVE = r"(\[[^\[\]]*\]\()(?![\w+]+:|#)"


class ReadmeHook(MetadataHookInterface):
    """Links to the files of the release: its tag is the version."""

    PLUGIN_NAME = "custom"

    def update(self, metadata: dict[str, Any]) -> None:
        """Set the field ``readme``."""
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        source, tag = metadata["urls"]["Source"], f"v{metadata['version']}"
        text = re.sub(rf"!{_RELATIVE}", rf"!\1{source}/raw/{tag}/", text)
        text = re.sub(_RELATIVE, rf"\1{source}/blob/{tag}/", text)
        metadata["readme"] = {"content-type": "text/markdown", "text": text}

"""Write the JSON files that keep the hunts of the study, with a line for each problem and sampler."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path


def write_hunts(path: Path, hunts: Mapping[str, Mapping[str, Any]]) -> None:
    """Write a nest of problem, sampler and results."""
    problems = (
        f" {json.dumps(problem)}: {{\n"
        + ",\n".join(f"  {json.dumps(sampler)}: {json.dumps(results)}" for sampler, results in row.items())
        + "\n }"
        for problem, row in hunts.items()
    )
    path.write_text("{\n" + ",\n".join(problems) + "\n}\n", encoding="utf-8")

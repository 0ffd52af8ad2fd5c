"""Which crashes of a gate count, if only those count that a competent driver would have prevented."""

from __future__ import annotations

import json
from collections import Counter
from contextlib import suppress
from typing import TYPE_CHECKING

from crashhunt.analysis import judge_preventability
from crashhunt.base.errors import CrashhuntError
from crashhunt.base.files import whole_file
from crashhunt.crashes import crash_folders, read_bundle
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

_FILE = "preventable.json"


class PreventableCrashes:
    """Judges the crashes of the hunts of a gate, each once. The answers are stored in the folder of the gate.

    A collision with another actor counts only if at least one model of a competent driver would have prevented it. If
    no model applies, or the runs do not decide it, the collision does not count. All other crashes count.
    """

    def __init__(self, place: Path, parallel: int) -> None:
        self._place, self._parallel = place, parallel
        self._answers: dict[str, str] = {}
        with suppress(OSError, ValueError):
            found = json.loads((place / _FILE).read_text(encoding="utf-8"))
            self._answers = {str(name): str(answer) for name, answer in found.items()}

    @property
    def numbers(self) -> Mapping[str, int]:
        """The number of crashes by answer: ``yes``, ``no``, ``unknown``, and ``no_collision``."""
        found = Counter(self._answers.values())
        return {answer: found[answer] for answer in ("yes", "no", "unknown", "no_collision")}

    def counts(self, hunt: Path, number: int) -> bool:
        """Return whether a crash counts.

        Raises:
            CrashhuntError: its trial cannot be run again.
        """
        name = f"{hunt.relative_to(self._place)}/{number}"
        if name not in self._answers:
            self._answers[name] = self._judge(hunt, number)
            with whole_file(self._place / _FILE) as temporary:
                temporary.write_text(json.dumps(self._answers), encoding="utf-8")
        return self._answers[name] in ("yes", "no_collision")

    def _judge(self, hunt: Path, number: int) -> str:
        for folder in crash_folders(hunt):
            if folder.name.startswith(f"{number:06d}-"):
                bundle = read_bundle(folder)
                hit = bundle.result.collision
                if bundle.result.outcome is not Outcome.COLLISION or hit is None or not hit.other:
                    return "no_collision"
                answer = judge_preventability(bundle, parallel=self._parallel)
                return "unknown" if answer is None else "yes" if answer else "no"
        raise CrashhuntError(f"the crash of trial {number} has no bundle", fix="do not delete crashes", where=str(hunt))

"""The two versions that a gate compares, and the work trees in which commits are built and imported."""

from __future__ import annotations

import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from crashhunt.base.agent_locators import is_program
from crashhunt.base.errors import CrashhuntError, UsageError
from crashhunt.base.git import (
    ORIGIN_SCRIPT,
    checked_out,
    commit_of,
    copy_built,
    import_environment,
    run_build,
    run_to_end,
    top_of,
    track_built,
)
from crashhunt.base.plugins import registered
from crashhunt.base.temporary import temporary_beside

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping
    from contextlib import ExitStack

_BUILT: Final = "built"
"""The files that --build has made for each version, in the folder of a kept gate."""


@dataclass(frozen=True, slots=True)
class GateVersion:
    """One of the two versions that a gate compares: BASE or HEAD."""

    word: str  # the version as the user named it
    # target of the agent of each vehicle, as in ``--agent``; empty if the version is a commit
    agents: Mapping[str, str]
    commit: str = ""  # hexadecimal digits of the commit; empty if the version is an agent

    @classmethod
    def of(cls, word: str, folder: Path) -> GateVersion:
        """Return the version that a word names: an agent, or else a commit of the folder's repository.

        Raises:
            UsageError: the word names neither an agent nor a commit.
        """
        vehicle, equals, locator = ("", "", word) if is_program(word) else word.rpartition("=")
        if ":" in locator or locator in registered("agents"):
            return cls(word, {vehicle: locator})
        if equals or not word:
            raise UsageError(f"{word!r} is neither an agent nor a commit", fix="give [ID=]MODULE:ATTR, or a revision")
        try:
            return cls(word, {}, commit_of(top_of(folder), word))
        except CrashhuntError as error:
            fix = "give a revision of the repository around this folder, or an agent as module:attribute"
            raise UsageError(f"{word!r} is neither an agent nor a commit: {error.message}", fix=fix) from None

    def __str__(self) -> str:
        """Return the name of the agent, or the revision with the first digits of its commit."""
        if not self.commit:
            return self.word
        return self.word if self.commit.startswith(self.word) else f"{self.word} ({self.commit[:10]})"


class WorkTrees:
    """The temporary work trees of two commits. There are none if the versions are agents."""

    def __init__(self, folder: Path, versions: Mapping[str, GateVersion], stack: ExitStack) -> None:
        self._folder, self._versions = folder, versions
        self._trees: dict[str, Path] = {}
        if any(version.commit for version in versions.values()):
            top = top_of(folder)
            for side, version in versions.items():
                self._trees[side] = stack.enter_context(checked_out(top, version.commit, purpose="gate", name=side))
            self._top = top.resolve()

    @property
    def folders(self) -> list[Path]:
        """The folder from which each commit is imported."""
        return [self.folder_of(side, self._folder) for side in self._trees]

    def folder_of(self, side: str, folder: Path) -> Path:
        """Return the folder from which a version is imported: a work tree, or the user's folder."""
        tree = self._trees.get(side)
        if tree is None:
            return folder
        resolved = folder.resolve()
        return tree / resolved.relative_to(self._top) if resolved.is_relative_to(self._top) else tree

    def environment_of(self, side: str) -> dict[str, str] | None:
        """Return the environment variables with which a commit is imported; None if there is no work tree."""
        if side not in self._trees:
            return None
        return import_environment(self.folder_of(side, self._folder), self._trees[side])

    def build(
        self, command: str, place: Path, *, limit_s: float, is_kept: bool, tell: Callable[[str], None],
    ) -> None:  # fmt: skip
        """Build each commit, or copy the files of an earlier build of the same gate, in its folder ``place``.

        A second build may differ in single bytes, and a hunt continues only with the code with which it began.
        """
        for side, tree in self._trees.items():
            kept = place / _BUILT / side
            if kept.is_dir():
                shutil.copytree(kept, tree, symlinks=True, dirs_exist_ok=True)
            else:
                name = f"{side.upper()} ({self._versions[side]})"
                log = place / f"build-{side}.log" if is_kept else None
                run_build(command, self.folder_of(side, self._folder), log, limit_s=limit_s, name=name, tell=tell)
                if is_kept:
                    kept.parent.mkdir(exist_ok=True)
                    with temporary_beside(kept) as building:
                        copy_built(tree, building)
                        building.rename(kept)
            track_built(tree)

    def check_origins(self, modules: Collection[str]) -> None:
        """Check that the modules of the agents are imported from the work trees.

        Raises:
            UsageError: an agent is imported from elsewhere, so that both versions would be the same.
        """
        for side, tree in self._trees.items():
            folder = self.folder_of(side, self._folder)
            environment = import_environment(folder, tree)
            origins = {module: _origin_of(module, folder, environment) for module in sorted(modules)}
            elsewhere = {module: place for module, place in origins.items() if not place.is_relative_to(tree)}
            if modules and len(elsewhere) == len(modules):
                module, place = next(iter(elsewhere.items()))
                raise UsageError(
                    f"{module!r} is imported from {place}, and not from the commit",
                    fix="run crashhunt gate in the folder that contains the module, with --agent module:attribute",
                )


def _origin_of(module: str, folder: Path, environment: Mapping[str, str]) -> Path:
    """Return the file from which a module is imported in a work tree; the tree's folder if it cannot be found."""
    done = run_to_end([sys.executable, "-P", "-c", ORIGIN_SCRIPT, module], folder, environment)
    return Path(done.stdout.strip()).resolve() if done.returncode == 0 else folder

"""Snapshots: the code, scenario and versions that a hunt ran with, stored in its directory."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._differences import (
        CodeChanges as CodeChanges,
        code_changes as code_changes,
        code_differences as code_differences,
        program_warnings as program_warnings,
    )
    from ._environment import (
        environment as environment,
        environment_changes as environment_changes,
        processor as processor,
        vector_extension as vector_extension,
        versions as versions,
    )
    from ._snapshot import Snapshot as Snapshot, latest_snapshot as latest_snapshot, without_code as without_code
    from ._take import SnapshotOptions as SnapshotOptions, take_snapshot as take_snapshot
    from ._unsaved import (
        describe_missing as describe_missing,
        describe_unsaved as describe_unsaved,
        with_original_paths as with_original_paths,
    )

offer_lazily(__name__)

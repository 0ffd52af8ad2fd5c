from ._snapshot import (
    Environment as Environment,
    Manifest as Manifest,
    Snapshot as Snapshot,
    environment as environment,
    environment_changes as environment_changes,
    latest_snapshot as latest_snapshot,
    processor as processor,
    versions as versions,
    without_code as without_code,
)
from ._take import SnapshotOptions as SnapshotOptions, take_snapshot as take_snapshot

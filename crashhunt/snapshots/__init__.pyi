from ._environment import (
    environment as environment,
    environment_changes as environment_changes,
    processor as processor,
    versions as versions,
)
from ._snapshot import (
    Snapshot as Snapshot,
    SnapshotOptions as SnapshotOptions,
    latest_snapshot as latest_snapshot,
    take_snapshot as take_snapshot,
)

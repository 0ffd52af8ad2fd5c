from ._environment import (
    environment as environment,
    environment_changes as environment_changes,
    processor as processor,
    versions as versions,
)
from ._snapshot import (
    Environment as Environment,
    Manifest as Manifest,
    Snapshot as Snapshot,
    latest_snapshot as latest_snapshot,
    without_code as without_code,
)
from ._take import SnapshotOptions as SnapshotOptions, take_snapshot as take_snapshot

"""Descriptor of the toy simulator: it has no table and reads no file."""

from __future__ import annotations

from crashhunt.scenario import Backend

BACKEND: Backend = Backend(
    title="the toy",
    reported_events=(),
    disturbances=("brake", "stop", "unseen"),
    side_effect=lambda *_: "",
    forkable=True,
)

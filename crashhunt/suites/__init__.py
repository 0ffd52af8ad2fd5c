"""Suites: many hunts, each in its own process; reruns and gates."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._gate_runs import Gate as Gate, GateProgress as GateProgress
    from ._gate_versions import GateVersion as GateVersion
    from ._hunt_reruns import rerun as rerun
    from ._request_file import RunRequest as RunRequest, trust_hunt as trust_hunt
    from ._scorecard_cases import run_scorecard as run_scorecard
    from ._suite_file import (
        Suite as Suite,
        SuiteEntry as SuiteEntry,
        default_suite as default_suite,
        describe_finished as describe_finished,
    )

offer_lazily(__name__)

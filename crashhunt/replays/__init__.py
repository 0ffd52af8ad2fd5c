"""Replays: run a crash again, compare the run with the recording, edit it, or examine it in a debugger or a window."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._prepare import (
        Code as Code,
        Look as Look,
        ReplayOptions as ReplayOptions,
        Rerun as Rerun,
        is_current_code as is_current_code,
        prepare as prepare,
        reruns_of as reruns_of,
    )
    from ._replaying import ReplayReport as ReplayReport, confirm as confirm, replay as replay, up_to as up_to

offer_lazily(__name__)

from ._avoidability import judge as judge
from ._edits import edited_disturbances as edited_disturbances, with_other_words as with_other_words
from ._prepare import (
    Code as Code,
    Ended as Ended,
    Look as Look,
    NotUnderstoodError as NotUnderstoodError,
    ReplayOptions as ReplayOptions,
    Rerun as Rerun,
    Reruns as Reruns,
    StoppedError as StoppedError,
    is_todays as is_todays,
    prepare as prepare,
)
from ._replay import (
    ReplayData as ReplayData,
    ReplayReport as ReplayReport,
    confirm as confirm,
    replay as replay,
    up_to as up_to,
)

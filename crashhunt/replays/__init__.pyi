from ._debugger import Look as Look
from ._replay import (
    Code as Code,
    ReplayOptions as ReplayOptions,
    ReplayReport as ReplayReport,
    Rerun as Rerun,
    confirm as confirm,
    prepare as prepare,
    replay as replay,
)

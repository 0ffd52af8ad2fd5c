from ._processes import run_all as run_all
from ._rerun import rerun as rerun
from ._suite import Suite as Suite, default_suite as default_suite

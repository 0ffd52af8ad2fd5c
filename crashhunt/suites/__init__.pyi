from ._origins import refuse_untrusted_hunt as refuse_untrusted_hunt, trust_hunt as trust_hunt
from ._processes import RunRequest as RunRequest, run_all as run_all
from ._rerun import rerun as rerun
from ._suite import Suite as Suite, SuiteEntry as SuiteEntry, default_suite as default_suite

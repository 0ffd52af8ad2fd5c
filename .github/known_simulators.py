"""Fails if the compiled parts do not know the installed libsumo or highway-env; called by a scheduled workflow.

usage: known_simulators.py libsumo | highway-env
"""

import sys
from importlib import metadata

import crashhunt
from crashhunt.native import why_no_link_order, why_not

version = metadata.version(sys.argv[1])
if sys.argv[1] == "libsumo":
    reasons = [reason for reason in (why_not(version), why_no_link_order(version)) if reason]
    todo = "test crashhunt/native with it, then add it to _CHECKED_VERSIONS in its three modules"
else:
    done = crashhunt.accelerate()
    reasons = [] if done else [f"not accelerated: {done.reason}"]
    todo = "run tests/on_highway/accelerator/test_accelerator.py with it, then add its digest to _known_versions.py"
print(f"{sys.argv[1]} {version}: {'; '.join(reasons) or 'known'}")
sys.exit(f"to do: {todo}" if reasons else 0)

"""Fails where the accelerator does not know the highway-env that is installed; called by a scheduled workflow."""

import sys

import crashhunt

done = crashhunt.accelerate()
if not done:
    sys.exit(f"not accelerated: {done.reason}")
print(f"accelerated, all but {list(done.left_alone) or 'nothing'}")

"""A module of an agent that does harm when it is imported: one error that names the import, or nothing."""

from __future__ import annotations

import shutil

import harms
import pytest
from conftest import mostly_nightly
from toy_trials import results_of, settings_for

from crashhunt.base.errors import CrashhuntError
from crashhunt.executors import FreshProcessExecutor, PoolExecutor
from crashhunt.executors._postmortem import agent_in_stack
from crashhunt.executors._time_limits import START_UP_S
from crashhunt.trial import TrialSpec

LIMIT_S = 2.0
TRIAL = TrialSpec(0, 7, {"ego": {}}, {}, 5)
KEEPS = ", which keeps 'driver:Agent' from being imported"
# Code and why the module cannot be imported; empty if it can.
DOES = {
    "while True: pass": f"it takes more than {LIMIT_S:g} s",
    "time.sleep(1e9)": f"it takes more than {LIMIT_S:g} s",
    "os._exit(3)": "its process exited with 3 meanwhile",
    "os._exit(0)": "its process exited with 0 meanwhile",
    "os.kill(os.getpid(), signal.SIGSEGV)": "its process was killed by SIGSEGV meanwhile",
    "os.kill(os.getpid(), signal.SIGKILL)": "its process was killed by SIGKILL meanwhile, ",
    "os.fork() or time.sleep(1e9); os._exit(3)": "its process exited with 3 meanwhile",  # a copy holds what it inherits
    "os.kill(os.getpid(), signal.SIGSTOP)": "",  # it is resumed
    "becomes_another_program": "its process exited with 0 meanwhile",
    "closes_everything": "its process exited with 1 meanwhile",
    "raises_bare": f"BareError: harm{KEEPS}",
    "raises_error": f"ValueError: harm{KEEPS}",
    "raises_mute": f"(its message cannot be had: RuntimeError){KEEPS}",
    "raises_long_message": f"more characters are left out){KEEPS}",
    "recurses": "RecursionError: maximum recursion depth exceeded",
    **dict.fromkeys(("deaf", "no_output", "starts_threads", "starts_daemon", "forks"), ""),
}
# By day, an import that hangs waits: one that calculates would take the processor from other tests for all of LIMIT_S.
ALWAYS = [("time.sleep(1e9)", PoolExecutor), ("os.kill(os.getpid(), signal.SIGKILL)", PoolExecutor),
          ("time.sleep(1e9)", FreshProcessExecutor), ("os._exit(3)", FreshProcessExecutor),
          ("raises_bare", PoolExecutor)]  # fmt: skip


@pytest.mark.parametrize(
    ("does", "kind"), mostly_nightly([(does, kind) for does in DOES for kind in (PoolExecutor, FreshProcessExecutor)],
                                     always=ALWAYS)
)  # fmt: skip
def test_import_that_does_harm_is_named_in_one_error(tmp_path, monkeypatch, does, kind):
    shutil.copy(harms.__file__, tmp_path)
    code = f"harms.HARMS[{does!r}][1]()" if does in harms.HARMS else does
    (tmp_path / "driver.py").write_text(f"import os, signal, time\nimport harms\n{code}\nAgent = harms.Agent\n")
    monkeypatch.chdir(tmp_path)
    # Imports may take START_UP_S longer than a trial; a negative limit of trials leaves those that hang 2 s.
    timeout_s = LIMIT_S - START_UP_S if DOES[does].startswith("it takes more") else 20.0
    executor = kind(settings_for(tmp_path, "driver:Agent", timeout_s=timeout_s), parallel=1)
    if not DOES[does]:
        results_of(executor, [TRIAL])
        return
    with pytest.raises(CrashhuntError) as caught:
        results_of(executor, [TRIAL])
    said = caught.value
    assert DOES[does] in said.message
    if DOES[does].startswith("it"):  # its process hung or ended
        assert said.message.startswith("the module 'driver' of agent ego cannot be imported: it")
        assert said.fix.startswith("see what the module does when it is imported")
    else:
        assert said.where.startswith("harms.py, line ")
    assert len(str(said).splitlines()) == 1


STACK = """Fatal Python error: Segmentation fault

Current thread 0x00007f (most recent call first):
  File "/usr/lib/python3.11/ctypes/__init__.py", line 5 in string_at
  File "/home/me/pkg/driver.py", line 3 in handle
  File "{ours}", line 9 in step
  File "/home/me/pkg/other.py", line 3 in act

Thread 0x00007e (most recent call first):
  File "/home/me/pkg/other.py", line 3 in handle
"""


# By day, the import above that is killed by SIGKILL each time is repeated as well.
@pytest.mark.parametrize("number", mostly_nightly(["SIGINT", "SIGKILL"], always=["SIGINT"]))
def test_import_that_is_killed_once_from_outside_is_repeated(tmp_path, monkeypatch, number):
    (tmp_path / "driver.py").write_text(
        "import os, pathlib, signal\nfrom crashhunt.agents import KeepLaneWithSpeed\n"
        "first = pathlib.Path(__file__).with_name('imported')\n"
        f"if not first.exists():\n    first.touch()\n    os.kill(os.getpid(), signal.{number})\n"
        "Agent = KeepLaneWithSpeed\n"
    )
    monkeypatch.chdir(tmp_path)
    settings = settings_for(tmp_path, "driver:Agent", timeout_s=20.0)
    found = results_of(FreshProcessExecutor(settings, parallel=1), [TRIAL])
    assert (tmp_path / "imported").exists()
    assert [result.failure for result in found] == [None]


def test_stack_names_the_agent_whose_code_lies_above_the_simulator():
    from crashhunt.base import layout

    stack = STACK.format(ours=layout.PACKAGE / "simulators" / "toy.py")
    assert agent_in_stack(stack, {"ego": "pkg.driver"}) == "ego"
    assert agent_in_stack(stack, {"ego": "driver", "two": "other"}) == "ego"
    assert agent_in_stack(stack, {"ego": "pkg.other"}) == ""  # which only called the simulator, or ran beside it
    assert agent_in_stack(stack, {"ego": "pkg.driver", "two": "pkg.driver"}) == ""
    assert agent_in_stack("", {"ego": "pkg.driver"}) == ""

"""An agent that does harm to the process it runs in. Tests copy this file to where they work."""

import builtins
import contextlib
import ctypes
import faulthandler
import gc
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time

KEPT = []
COUNT = 0


class MuteError(Exception):
    def __str__(self):
        raise RuntimeError("no words")


class LeavingError(Exception):
    def __str__(self):
        sys.exit(4)


class Agent:
    settings = {"speed": 5.0}

    def __init__(self, what: str = ""):
        self.what = what
        if what == "exits_in_init":
            sys.exit(4)

    def reset(self, seed):
        self.step = 0
        if self.what == "exits_in_reset":
            sys.exit(4)

    def act(self, observation, seen=[]):
        self.step += 1
        if self.step == 5 and self.what:
            getattr(self, self.what, lambda: None)()
        return self.settings["speed"] + COUNT + len(seen) + random.random() * 0.01, 0

    def close(self):
        if self.what == "exits_in_close":
            sys.exit(4)
        if self.what == "interrupts_in_close":
            raise KeyboardInterrupt

    # Exceptions that nobody expects.
    def mute(self):
        raise MuteError

    def leaving(self):
        raise LeavingError

    def surrogate(self):
        raise ValueError("half \udcff a letter")

    def shouts(self):
        raise ValueError("no! " * 12_500_000)

    def interrupts(self):
        raise KeyboardInterrupt

    def exits(self):
        sys.exit(4)

    # Files.
    def leaks(self):
        with contextlib.suppress(OSError):
            while True:
                KEPT.append(open(os.devnull))

    def closes_output(self):
        os.close(1)
        os.close(2)

    def closes_everything(self):
        os.closerange(0, 1000)

    def limits_files(self):
        resource.setrlimit(resource.RLIMIT_NOFILE, (1, 1))

    def leaves_folder(self):
        folder = tempfile.mkdtemp()
        os.chdir(folder)
        os.rmdir(folder)

    # Python itself.
    def no_open(self):
        builtins.open = None

    def no_length(self):
        builtins.len = None

    def no_modules(self):
        sys.modules.clear()

    def no_output(self):
        sys.stdout = sys.stderr = None

    def no_json(self):
        json.dumps = json.encoder.JSONEncoder.encode = None

    def no_random(self):
        random.random = lambda: 0.5

    def no_environment(self):
        os.environ.clear()

    def no_collection(self):
        gc.disable()
        faulthandler.disable()

    def shallow(self):
        sys.setrecursionlimit(sys.getrecursionlimit() // 2)

    def deaf(self):
        for number in (signal.SIGTERM, signal.SIGUSR1, signal.SIGALRM):
            signal.signal(number, signal.SIG_IGN)

    # Its own module.
    def counts(self):
        global COUNT
        COUNT += 1

    def sets_inside(self):
        Agent.settings["speed"] = 9.0

    def fills_default(self):
        Agent.act.__defaults__[0].append(1)

    # Threads and processes.
    def thread(self):
        def draw():
            while True:
                random.random()
                time.sleep(0.001)

        threading.Thread(target=draw, daemon=True).start()

    def program(self):
        KEPT.append(subprocess.Popen(["sleep", "986"]))

    def daemon(self):
        subprocess.run(["setsid", "sh", "-c", "sleep 986 & sleep 986 &"], check=True)

    def forks(self):
        os.fork()

    def dies_with_program(self):
        self.daemon()
        os._exit(3)

    def segfaults(self):
        ctypes.string_at(0)

    def kills_itself(self):
        os.kill(os.getpid(), signal.SIGKILL)

    def terminates_itself(self):
        os.kill(os.getpid(), signal.SIGTERM)

    def terminates_group(self):
        os.killpg(0, signal.SIGTERM)
        time.sleep(60)

    def kills_parent(self):
        os.kill(os.getppid(), signal.SIGKILL)
        time.sleep(60)

    def hangs_with_program(self):
        self.daemon()
        ctypes.PyDLL(None).sleep(1000)

"""An agent that forges the result of its trial. Tests copy this file to where they work."""

import ctypes
import gc
import json
import os
import struct
import time
from pathlib import Path

from crashhunt.executors._postmortem import encode_report
from crashhunt.recording import BlackBox
from crashhunt.recording._blackbox import FIRST, HEADER, REPORT, REPORT_OFFSET

DIGEST = "f" * 32
FORGED = {
    "outcome": "finished", "steps": 3, "sim_time_s": 0.3, "digest": DIGEST, "collision": None, "failure": None,
    "closest": {}, "wall_s": 0.1, "setup_s": 0.1, "worker": 1, "kept": False,
}  # fmt: skip


def folder():
    return Path(os.readlink("/proc/self/fd/1")).parent


def path():
    return folder() / "blackbox.bin"


def box():
    """The recorder's own object."""
    return next(one for one in gc.get_objects() if type(one) is BlackBox)


def report(key=bytes(16)):
    return encode_report({"result": FORGED, "notices": ["forged"]}, key, DIGEST)


def put(offset, data):
    with open(path(), "r+b") as file:
        file.seek(offset)
        file.write(data)


class Agent:
    def __init__(self, how=""):
        self.how = how

    def reset(self, seed):
        self.step = 0

    def act(self, observation):
        self.step += 1
        if self.step == 5 and self.how:
            getattr(self, self.how)()
        return 5.0, 0

    # Messages.
    def answer_into_every_descriptor(self):
        spec = {"number": 0, "seed": 7, "arguments": {}, "scenario_arguments": {}, "max_steps": 12}
        line = json.dumps({"result": {**FORGED, "spec": spec}, "retires": False}).encode() + b"\n"
        for descriptor in range(3, 64):
            try:
                os.write(descriptor, line)
            except OSError:
                continue

    def error_into_every_descriptor(self):
        for descriptor in range(3, 64):
            try:
                os.write(descriptor, b'{"error": {"message": "over", "fix": "", "where": ""}}\n{"ended": 0}\n')
            except OSError:
                continue

    def answer_file(self):
        spec = {"number": 0, "seed": 7, "arguments": {}, "scenario_arguments": {}, "max_steps": 12}
        for name in ("answer-000000.json", "trial-000000/answer.json", "answer.json"):
            try:
                (folder().parent / name).write_text(json.dumps({"result": {**FORGED, "spec": spec}}))
            except OSError:
                continue

    # Reports.
    def report_by_path(self):
        said = report()
        header = HEADER.unpack(path().read_bytes()[: HEADER.size])
        put(header[5], said)
        put(REPORT_OFFSET, REPORT.pack(len(said)))
        os._exit(0)

    def report_by_own_classes(self):
        box().report(report())
        os._exit(0)

    def report_and_goes_on(self):
        box().report(report())

    def report_of_endless_length(self):
        put(REPORT_OFFSET, b"\xff" * (FIRST - REPORT_OFFSET))
        os._exit(0)

    def report_of_negative_length(self):
        put(REPORT_OFFSET, REPORT.pack(1 << 31))
        os._exit(0)

    def report_by_child_that_stays(self):
        if os.fork() == 0:
            while True:
                try:
                    put(FIRST, b"\0" * 64)
                    put(REPORT_OFFSET, REPORT.pack(40))
                except OSError:
                    pass
                time.sleep(0.001)
        time.sleep(0.05)

    def exit_without_report(self):
        os._exit(0)

    # The file.
    def header_through_descriptor(self):
        for name in os.listdir("/proc/self/fd"):
            try:
                if os.readlink(f"/proc/self/fd/{name}") == str(path()):
                    os.pwrite(int(name), bytes(FIRST), 0)
            except OSError:
                continue

    def header_of_another_trial(self):
        header = list(HEADER.unpack(path().read_bytes()[: HEADER.size]))
        header[3] += 1
        put(0, HEADER.pack(*header))
        os._exit(0)

    def fewer_records(self):
        header = list(HEADER.unpack(path().read_bytes()[: HEADER.size]))
        header[5] = FIRST + 8
        put(0, HEADER.pack(*header))

    def more_records(self):
        header = list(HEADER.unpack(path().read_bytes()[: HEADER.size]))
        header[5] += 1 << 40
        put(0, HEADER.pack(*header))
        os._exit(0)

    def garbage_records(self):
        put(FIRST, b"\x01\x00\xff\xfe" * 1024)

    def truncated(self):
        os.truncate(path(), 0)
        os._exit(0)

    def truncated_at_step_5(self):
        os.truncate(path(), FIRST + 300)

    def grown(self):
        os.truncate(path(), 1 << 40)

    def replaced(self):
        other = folder() / "other"
        other.write_bytes(path().read_bytes())
        other.rename(path())
        put(FIRST, b"\0" * 100)

    def link_to_another_file(self):
        path().unlink()
        path().symlink_to("/etc/passwd")

    def folder_is_a_link(self):
        place = folder()
        moved = place.with_name("moved")
        place.rename(moved)
        place.symlink_to(moved)

    def memory_of_recorder(self):
        """Overwrites the records where they are mapped."""
        for line in Path("/proc/self/maps").read_text().splitlines():
            if line.endswith("blackbox.bin"):
                start = int(line.partition("-")[0], 16)
                ctypes.memset(start + FIRST, 0, struct.calcsize("<Q") * 20)

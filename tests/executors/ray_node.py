"""What runs trials on a node of Ray, in the process of a test, with a pool of which the test says what ends next."""

from __future__ import annotations

from contextlib import contextmanager

from crashhunt.executors.ray._code_archive import NodeFolder
from crashhunt.executors.ray._node_worker import Work
from crashhunt.recording import BlackBoxHeader, Phase
from crashhunt.trial import TrialSpec


class Pool:
    """The pool of a node: `ends` are the results of each call."""

    def __init__(self, *ends):
        self.ends, self.submitted, self.cancelled, self.said, self.waits = list(ends), [], [], [], []
        self.header = BlackBoxHeader(5, 1, 2.0, 300, 4, Phase.ACT, 0)

    def submit(self, given):
        if given.number == 99:
            raise OSError("no file")
        self.submitted.append(given.number)

    def cancel(self, *, above):
        self.cancelled.append(above)
        self.submitted = [number for number in self.submitted if number <= above]

    def completed(self, wait_s):
        self.waits.append(wait_s)
        yield from self.ends.pop(0) if self.ends else ()

    def where(self):
        return {1: self.header}

    def notes(self):
        return self.said

    def close(self):
        self.closed = True


@contextmanager
def node_works(settings, folder, monkeypatch):
    """Yield a function that makes what runs trials on a node, with a pool that ends so."""
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "")  # which is set
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    made = []

    def make(*ends, slots=1):
        job = {"settings": settings.to_json(), "digest": "", "folders": {}, "home": "", "slots": slots}
        made.append(Work(job))
        made[-1]._place = NodeFolder()
        made[-1]._pool = Pool(*ends)
        return made[-1]

    yield make
    for one in made:
        one.close()


def submissions(*numbers):
    return [(100 + number, TrialSpec(number, number, {}, {}, max_steps=3).to_json()) for number in numbers]

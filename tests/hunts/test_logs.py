from __future__ import annotations

from crashhunt.ledger import Ledger
from crashhunt.results import LogReader


def test_only_what_is_new_is_read_however_long_a_log_is(tmp_path):
    log = tmp_path / "run.log"
    log.write_text("old\n" * 500_000 + "end\n")
    reader = LogReader(tmp_path, ("run", "error", "state"))
    ((title, text),) = reader.fresh()
    assert (title, len(text), text[-4:]) == ("run", 1_000_000, "end\n")
    assert list(reader.fresh()) == []
    with log.open("a") as file:
        file.write("new\n")
    assert list(reader.fresh()) == [("run", "new\n")]
    ledger = Ledger(tmp_path / "ledger.sqlite", writable=True)
    for state in ("running", "crash"):
        ledger.enter(state)
        ((title, text),) = reader.fresh()
        assert (title, text.split()[-1]) == ("state", state)
    ledger.close()

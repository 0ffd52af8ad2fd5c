"""The command ``crashhunt``, and ``python -m crashhunt``."""

import sys
from typing import NoReturn

from crashhunt.base.signals import is_interrupt, remember_interrupts


def main() -> NoReturn:
    """Run the command line and exit."""
    remember_interrupts()  # before the imports that may drop one
    try:
        from crashhunt.cli import main as run
    except BaseException as error:
        if is_interrupt(error):
            sys.exit(130)
        raise
    run()


if __name__ == "__main__":
    if sys.version_info < (3, 11):  # noqa: UP036 - pip refuses an older Python, and a clone runs with any
        sys.stderr.write("crashhunt needs Python 3.11 or later; in a clone, run scripts/crashhunt\n")
        sys.exit(2)
    if not sys.flags.safe_path:
        del sys.path[0]  # the current folder, which may be a stranger's, and whose modules only the user may name
    main()

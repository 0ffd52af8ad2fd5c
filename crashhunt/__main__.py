"""``python -m crashhunt``."""

from crashhunt.cli import main

if __name__ == "__main__":
    main()

"""``python -m railfix``."""

from railfix.cli import main

if __name__ == "__main__":
    main()

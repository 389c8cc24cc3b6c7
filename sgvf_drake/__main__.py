"""``python -m sgvf_drake`` is ``sgvf``."""

from sgvf_drake.cli import main

if __name__ == "__main__":
    main()

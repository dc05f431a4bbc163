"""``python -m srm_mbs``: the command line."""

from srm_mbs.cli import main

if __name__ == "__main__":
    main()

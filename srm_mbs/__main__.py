"""``srm-mbs`` and ``python -m srm_mbs``: the command line.

It is loaded here, not at the top, because Ctrl-C ends a program that is still loading without a
word, as a signal does by default.
"""

import signal


def main() -> None:
    """Load the command line and run it."""
    # A shell that ignores the signal decides for the program.
    own = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if own:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from srm_mbs.cli.app import main as run

    if own:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    run()


if __name__ == "__main__":
    main()

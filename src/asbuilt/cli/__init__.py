"""The command line: one file per group of commands, the demonstration and the 2015 paper."""

import signal
import sys

INTERRUPTED = 128 + signal.SIGINT
"""Exit status of shells after Ctrl-C."""


def run() -> None:
    """Run the command line; Ctrl-C while its modules are imported ends it without a traceback."""
    try:
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, signal.SIG_DFL)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    from asbuilt.isolation import leave_current_folder

    leave_current_folder()
    from asbuilt.cli.app import main

    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    main()

"""The command `tapetum`, and `python -m tapetum`.

The command line imports for half a second: Ctrl-C during that time ends it in one line too.
"""

import signal
import sys


def main() -> int:
    """Run the command line; see `tapetum.cli.app.main`."""
    # A scheduler's or a closing terminal's signal ends a command as Ctrl-C does: it says what it kept. `nohup` ignores.
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, signal.default_int_handler)
    try:
        from tapetum.cli.app import main as run

        return run()
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        return 130


if __name__ == "__main__":
    sys.exit(main())

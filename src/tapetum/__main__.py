"""The command `tapetum`, and `python -m tapetum`.

The command line imports for half a second: Ctrl-C during that time ends it in one line too.
"""

import sys


def main() -> int:
    """Run the command line; see `tapetum.cli.app.main`."""
    try:
        from tapetum.cli.app import main as run

        return run()
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        return 130


if __name__ == "__main__":
    sys.exit(main())

"""What `pumafuse` and `python -m pumafuse` run."""

import sys


def main() -> None:
    """Run the command line; interrupted while it is still imported, it ends as it does later."""
    try:
        from .cli.main import main as run

        run()
    except KeyboardInterrupt:
        if sys.stderr is not None:  # pyright: ignore[reportUnnecessaryComparison]
            sys.stderr.write("interrupted\n")
        sys.exit(130)


if __name__ == "__main__":
    main()

"""`python -m pumafuse`, the same as `pumafuse`."""

from .cli.main import main

main()

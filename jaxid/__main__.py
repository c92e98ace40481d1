"""`python -m jaxid` is the command `jaxid`."""

from .cli import main

main()

"""The command line: one file a command. Reads options, calls one function, prints; what is heavy is imported inside."""

from vtfs.cli.application import main

__all__ = ["main"]

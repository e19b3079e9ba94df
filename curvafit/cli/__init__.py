"""The command line: parse, call, print; a module for each command."""
